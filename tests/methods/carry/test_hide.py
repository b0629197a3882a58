"""Carrying from files and scenes, on the command line and in Python."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import keyss
from channels.lsb.trained_like import trained_like
from cli.harness import Run, write_key
from keyss import CarryOptions, FitConfig, Secret
from keyss.core import UsageError
from keyss.files import read_model, write_model
from tiny_scenes import random_gaussians, tiny_scene

KEY = "a key of many characters: 93hXmQ2"
HIDE = ("hide", "--width", 48, "--key-file", "key")


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("files")
    write_model(folder / "cover.ply", trained_like(2500))
    write_model(folder / "secret.ply", trained_like(900, 1))
    write_model(folder / "large.ply", trained_like(6000, 2))
    write_key(folder / "key", KEY)
    write_key(folder / "other", KEY + "4")
    return folder


@pytest.fixture
def run(files: Path, keyss: Run, monkeypatch: pytest.MonkeyPatch) -> Run:
    """Run the command line in the folder of the files."""
    monkeypatch.chdir(files)
    return keyss


def test_hide_and_reveal_files(run: Run, tmp_path: Path) -> None:
    status, out, err = run(*HIDE, "--cover", "cover.ply", "--secret", "secret.ply", "-o", tmp_path / "out")
    assert (status, err) == (0, "")
    assert "900" in out
    assert "Chance level" not in out
    names = {str(path.relative_to(tmp_path / "out")) for path in (tmp_path / "out").rglob("*.*")}
    assert names == {
        "publish/model.ply",
        *("private/look.png", "private/metrics.json", "private/config.json", "private/manifest.json"),
    }
    metrics = json.loads((tmp_path / "out/private/metrics.json").read_text())
    assert metrics["secret_gaussians"] == [900]
    assert 100 < metrics["details"]["bits_per_gaussian"][0] < 568
    assert metrics["cover"]["psnr"] == pytest.approx(metrics["baseline"]["cover"]["psnr"], abs=0.1)
    assert metrics["secrets"][0]["psnr"] > 48
    assert metrics["secrets"][0]["psnr"] > metrics["chance_level"][0] + 20
    assert metrics["wrong_key"] is None
    stego = tmp_path / "out/publish/model.ply"
    assert run("reveal", stego, "--key-file", "key", "-o", tmp_path / "secret.ply")[0] == 0
    assert len(read_model(tmp_path / "secret.ply")) == 900
    assert run("reveal", stego, "--key-file", "other", "-o", tmp_path / "none.ply")[0] == 3
    assert run("evaluate", tmp_path / "out", "--key-file", "key")[0] == 0
    assert json.loads((tmp_path / "out/private/metrics.json").read_text()) == metrics
    status, _, err = run("evaluate", tmp_path / "out", "--key-file", "key", "--wrong-keys", 3)
    assert (status, "no decoder" in err) == (2, True)
    assert run("reveal", stego, "--key-file", "key", "--frame", "cover", "-o", tmp_path / "n.ply")[0] == 2
    assert KEY not in "".join(path.read_text() for path in (tmp_path / "out").rglob("*.json"))


@pytest.mark.parametrize(
    ("arguments", "having"),
    [
        (("--design", "released"), "keyss"),
        (("--mask", "op", "--method=carry"), "keyss"),
        (("--key_encoder=clip", "--method", "keyss", "--method", "carry"), "keyss"),
        (("--fine-tune", "never", "--method", "keyss"), "carry"),
    ],
)
def test_options_of_other_methods(run: Run, tmp_path: Path, arguments: tuple[str, ...], having: str) -> None:
    hide = ("hide", "--cover", "cover.ply", "--secret", "secret.ply", "--key-file", "key")
    status, _, err = run(*hide, "-o", tmp_path / "out", *arguments)
    assert status == 2
    assert f"an option of --method {having}; " in err
    assert not (tmp_path / "out").exists()


def test_secret_from_photos(tmp_path: Path) -> None:
    options = CarryOptions(fit=FitConfig(iterations=30, max_gaussians=300, evaluate_every=0, seed=0))
    result = keyss.hide(
        trained_like(1500),
        [Secret(tiny_scene(1), KEY)],
        method=options,
        views=keyss.ViewOptions(48),
        out=tmp_path / "run",
    )
    assert (tmp_path / "run/private/secret-1.ply").exists()
    (secret,), (plain,) = result.metrics.secrets, result.metrics.baseline.secrets
    assert plain is not None
    assert secret.psnr == pytest.approx(plain.psnr, abs=0.05)
    revealed = keyss.reveal(tmp_path / "run/publish/model.ply", KEY).gaussians
    assert (len(revealed),) == result.metrics.secret_gaussians
    with pytest.raises(UsageError, match="scenes in memory"):
        keyss.evaluate(tmp_path / "run", [KEY])


@pytest.mark.parametrize(("steps", "views"), [(5, 16), (15, 3)])
@pytest.mark.filterwarnings("ignore::keyss.core.KeyssWarning")  # of appended Gaussians
def test_hide_in_cover_of_few_steps(steps: int, views: int) -> None:
    """After few steps most Gaussians are round and grey, with predictable low bits."""
    scene = tiny_scene(0, views)
    points = torch.randn(1500, 3, generator=torch.Generator().manual_seed(0))
    cover = replace(scene, points=points, colors=(255 * points.sigmoid()).to(torch.uint8))
    options = CarryOptions(fit=FitConfig(iterations=steps, max_gaussians=1500, evaluate_every=0, seed=0))
    secret = Secret(random_gaussians(300), KEY)
    result = keyss.hide(cover, [secret], method=options, views=keyss.ViewOptions(24))
    assert result.metrics.secret_gaussians == (300,)
    assert result.metrics.against_plain[0].psnr > 40


def test_min_psnr_of_pruned_secret(run: Run, tmp_path: Path) -> None:
    hide = (*HIDE, "--cover", "cover.ply", "--secret", "large.ply", "--format", "spz", "--fine-tune=never")
    status, out, err = run(*hide, "-o", tmp_path / "out")
    assert status == 7
    assert re.search(r"the secret with [\d,]+ of 6,000 Gaussians is at .* below 25 dB: nothing was", err)
    assert "--resume" not in err  # no training to resume
    assert "below 24 dB" in run(*hide, "-o", tmp_path / "out", "--min-psnr", 24)[2]
    status, out, _ = run(*hide, "-o", tmp_path / "out", "--min-psnr", 0)
    assert status == 0
    assert "of 6,000 Gaussians, " in out
