"""Real photos at full length (`make test-slow`)."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import keyss
from keyss import CarryOptions, FitConfig, Secret
from keyss.cli import main
from keyss.lab.audits import audit, read_audit

pytestmark = pytest.mark.slow
CONFIG = CarryOptions(fit=FitConfig(max_gaussians=20_000, seed=0))


@pytest.fixture(scope="module")
def run(real_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Fox hidden in bonsai at width 200 with 20,000 Gaussians."""
    out = tmp_path_factory.mktemp("runs") / "hidden"
    secret = Secret(real_data / "fox", "a key for a fox")
    keyss.hide(
        real_data / "bonsai", [secret], method=CONFIG, views=keyss.ViewOptions(200), bound=True, out=out
    )
    return out


def test_hide_fox_in_bonsai(run: Path) -> None:
    """Against plain 3DGS with the same budget; the secret has 2.15 times the cover's steps."""
    metrics = keyss.evaluate(run, ["a key for a fox"])
    (secret,), (plain,) = metrics.secrets, metrics.baseline.secrets
    assert metrics.seconds < 10 * 60
    assert metrics.cover.psnr > metrics.baseline.cover.psnr - 0.01
    assert metrics.baseline.steps == metrics.steps == (1000, 2150)
    assert secret.psnr > plain.psnr - 0.5
    assert metrics.wrong_key is None  # wrong keys open nothing


def test_audit_of_leaks_and_robustness(run: Path) -> None:
    audit(run, ["a key for a fox"], controls=2, only=["leaks", "robustness"])
    words = {line.measure: line.word for line in read_audit(run).verdicts}
    assert words["leaks without the key"] == "fine"
    assert words["loss of a random 25% of the Gaussians"] == "fine"


def test_audit_of_stealth(run: Path, real_data: Path, tmp_path: Path) -> None:
    plain = [run / "private" / name for name in ("cover.ply", "secret-1.ply")]
    secret = Secret(real_data / "fox", "a key for a fox", plain[1])
    out = tmp_path / "carried"
    keyss.hide(
        real_data / "bonsai",
        [secret],
        method=CarryOptions(fit=CONFIG.fit),
        views=keyss.ViewOptions(200),
        cover_model=plain[0],
        out=out,
    )
    audit(out, ["a key for a fox"], controls=2, only=["parameters", "leaks"])
    words = {line.measure: line.word for line in read_audit(out).verdicts}
    for measure in ("attributes of the Gaussians", "classifier between models", "leaks without the key"):
        assert words[measure] == "fine"


@pytest.mark.parametrize(("cover", "secret"), [("miku", "lego"), ("lego", "fox"), ("fox", "miku")])
def test_other_pairs(real_data: Path, cover: str, secret: str) -> None:
    """White and empty backgrounds, no points, partial and full rings of cameras."""
    config = CONFIG.with_fit(iterations=1000, max_gaussians=10_000)
    secrets = [Secret(real_data / secret, "key")]
    metrics = keyss.hide(
        real_data / cover, secrets, method=config, views=keyss.ViewOptions(160), bound=True
    ).metrics
    assert metrics.cover.psnr > metrics.baseline.cover.psnr - 0.01
    assert metrics.secrets[0].psnr > metrics.baseline.secrets[0].psnr - 1


def test_hide_model_in_model(real_data: Path, tmp_path: Path) -> None:
    (tmp_path / "key").write_text("a key for a guitar")
    (tmp_path / "key").chmod(0o600)
    splats, out = real_data / "splats", ["-o", str(tmp_path / "out")]
    arguments = ["hide", "--cover", splats / "playbot_lod4.ply", "--secret", splats / "guitar.ply"]
    assert main([*map(str, arguments), "--key-file", str(tmp_path / "key"), *out]) == 0
    metrics = json.loads((tmp_path / "out" / "private" / "metrics.json").read_text())
    assert metrics["cover"]["psnr"] > 50
    assert metrics["secrets"][0]["psnr"] > 43.75  # the precision of appended Gaussians
