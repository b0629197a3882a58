"""The table that `hide` prints."""

from __future__ import annotations

import io
import re
from contextlib import redirect_stdout
from dataclasses import replace

import pytest

from cli.harness import METRICS
from keyss.cli.tables import print_hiding
from keyss.fitting import ImageQuality
from keyss.measure import PsnrRange, WrongKeys
from keyss.runs import HideMetrics


def table(metrics: HideMetrics) -> list[list[str]]:
    with redirect_stdout(io.StringIO()) as out:
        print_hiding(metrics)
    return [re.split("  +", line.strip()) for line in out.getvalue().splitlines()]


@pytest.fixture(autouse=True)
def narrow(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")


def test_rows() -> None:
    rows = table(METRICS)
    assert rows[:4] == [
        ["on test photos", "PSNR", "SSIM", "bound", "loss", "Gaussians", "steps"],
        ["cover", "30.00", "0.500", "30.50", "0.50", "1,234", "10"],
        ["secret", "20.00", "0.250", "567", "20"],
        [
            "PSNR in dB; SSIM: 1 if equal; bound: PSNR of plain 3DGS with the same steps; "
            "loss: bound - PSNR; steps: training steps."
        ],
    ]
    assert rows[-1] == ["Capacity of the cover: 1,000 Gaussians."]


def test_pruned_secret() -> None:
    baseline = replace(METRICS.baseline, gaussians=(10, 8406))
    fewer = replace(METRICS, baseline=baseline, secret_gaussians=(2480,), secret_degrees=((0, 3),))
    assert ["The secret kept 2,480 of 8,406 Gaussians, SH degree 0 of 3."] in table(fewer)
    assert not any(
        "kept" in row[0] for row in table(replace(METRICS, baseline=replace(baseline, gaussians=(10, 567))))
    )


def test_several_pruned_secrets_have_numbers() -> None:
    two = {name: 2 * getattr(METRICS, name) for name in ("secrets", "secret_gaussians", "secret_degrees")}
    baseline = replace(
        METRICS.baseline,
        secrets=(None, None),
        gaussians=(1234, 600, 700),
        steps=(10, 20, 20),
        equal=(True, False, False),
    )
    last = METRICS.against_plain[1:]
    more = {"photos": (True,) * 3, "steps": (10, 20, 20), "against_plain": METRICS.against_plain + last}
    rows = table(replace(METRICS, baseline=baseline, **two, **more))
    assert ["Secret 1 kept 567 of 600 Gaussians."] in rows
    assert ["Secret 2 kept 567 of 700 Gaussians."] in rows


def test_shorter_plain_model_is_no_bound() -> None:
    shorter = replace(METRICS.baseline, secrets=(ImageQuality(19.0, 0.2),))
    rows = table(replace(METRICS, baseline=shorter))
    assert rows[0] == [
        *("on test photos", "PSNR", "SSIM", "bound", "loss", "start"),
        *("Gaussians", "steps"),
    ]
    assert rows[2] == ["secret", "20.00", "0.250", "19.00", "567", "20"]
    assert any("; start: PSNR of a plain model with fewer steps" in row[0] for row in rows)


@pytest.mark.parametrize(("highest", "unlearnt"), [(19.5, True), (12.0, False)])
def test_secrets_that_no_key_shows(highest: float, unlearnt: bool) -> None:
    """A short training leaves wrong keys as good as the right one."""
    wrong = WrongKeys(2, PsnrRange(29, 28, 30), (PsnrRange(11, 10, highest),))
    rows = table(replace(METRICS, wrong_key=wrong, chance_level=(10.0,)))
    assert (["Wrong keys show as much of the secret as its key: train longer."] in rows) == unlearnt


@pytest.mark.parametrize(("mean", "harmed"), [(20.0, True), (29.0, False)])
def test_wrong_keys_that_harm_the_cover(mean: float, harmed: bool) -> None:
    wrong = WrongKeys(2, PsnrRange(mean, 19, 30), (PsnrRange(11, 10, 12),))
    cover = replace(METRICS.cover, psnr=30.0)
    rows = table(replace(METRICS, cover=cover, wrong_key=wrong, chance_level=(10.0,)))
    assert (["Wrong keys cost the cover 10.0 dB: train longer."] in rows) == harmed


def test_renders_of_models_are_rounded() -> None:
    """The error of rounding is 58.92 dB, and less where pixels are black or white."""
    renders = table(replace(METRICS, photos=(False, False)))
    words = "PSNR in dB; SSIM: 1 if equal. Renders that differ only by rounding to 8 bits have 59 dB or more."
    assert renders[3] == [words]
