"""--quiet, --verbose, and plans before long runs."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from cli.harness import SMALL, Result, Run, listing, scene_arguments
from keyss import progress
from keyss.files import write_model
from keyss.runs import planning
from tiny_scenes import random_gaussians


def fit(keyss: Run, scene: Path, *more: object) -> Result:
    return keyss("fit", scene, "-o", scene.parent / "out", "--seed", 0, *SMALL[2:], *more)


@pytest.mark.parametrize("flag", ["-q", "--quiet"])
def test_quiet(keyss: Run, scene: Path, flag: str) -> None:
    usual = fit(keyss, scene)
    assert "fit b: 20 steps" in usual.err
    quiet = fit(keyss, scene, "--overwrite", flag)
    assert (quiet.status, quiet.err) == (0, "")
    out = scene.parent / "out"
    assert quiet.out == f"{out / 'model.ply'}\n{out / 'private'}\n"
    assert str(out / "model.ply") in usual.out
    assert "on test photos" in usual.out
    assert "PSNR in dB" in usual.out
    assert progress.level == 0


def test_quiet_prints_paths_only(keyss: Run, tmp_path: Path) -> None:
    write_model(tmp_path / "a.ply", random_gaussians(50))
    commands = {
        "key.txt": ("keygen", "-o", tmp_path / "key.txt"),
        "a.spz": ("convert", tmp_path / "a.ply", "-o", tmp_path / "a.spz"),
        "page.html": ("view", tmp_path / "a.ply", "-o", tmp_path / "page.html"),
        "turn.webp": ("render", tmp_path / "a.ply", "-o", tmp_path / "turn.webp", "--width", 16),
    }
    for name, command in commands.items():
        assert keyss("-q", *command) == (0, f"{tmp_path / name}\n", "")
    images = keyss("render", tmp_path / "a.ply", "-o", tmp_path / "images", "--width", 16).out
    assert "60 images; private/ lists them for --overwrite" in images


def test_quiet_keeps_errors(keyss: Run, tmp_path: Path) -> None:
    assert keyss("-q", "info", tmp_path / "no.ply").err.startswith("keyss: error: ")


@pytest.mark.parametrize("flag", ["-v", "--verbose"])
def test_verbose_prints_duration(keyss: Run, scene: Path, flag: str) -> None:
    result = keyss(flag, *("fit", scene, "-o", scene.parent / "out", *SMALL[2:]))
    assert re.search(r"\nkeyss: done in \d+\.\d s\n$", result.err)
    assert progress.level == 0
    assert "done in" not in keyss(flag, "info", scene.parent / "no.ply").err


def test_estimates_of_long_runs_are_announced(
    keyss: Run, scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "about" not in fit(keyss, scene).err
    monkeypatch.setattr(planning, "_LONG", 0.0)
    words = r"about \d+ s on the CPU, \d\.\d GB of memory, up to \d+ MB of disk"
    assert re.search(rf"^fit: {words}\n.*fit b: 20 steps", fit(keyss, scene, "--overwrite").err, re.DOTALL)
    assert "about" not in fit(keyss, scene, "-q", "--overwrite").err


def test_dry_run(keyss: Run, workspace: Path, tmp_path: Path) -> None:
    scenes = scene_arguments(workspace)
    result = keyss("hide", "--publish", "converted", *scenes, "-o", tmp_path / "out", *SMALL, "--dry-run")
    assert result.status == 0, result.err
    for words in ("capacity ", "cost ", " of memory", " of disk"):
        assert words in result.out, words
    assert re.search(r"up to [5-9]\d\d Gaussians of SH degree 3", result.out)
    assert "appended to the cover's 100" in result.out
    assert listing(tmp_path) == {}
    result = keyss("hide", *scenes, "-o", tmp_path / "out", *SMALL, "--dry-run")
    assert result.status == 0
    assert "falling back to --publish converted" in result.err  # too few for low bits
    assert listing(tmp_path) == {}


def test_dry_run_of_a_fit(keyss: Run, workspace: Path, tmp_path: Path) -> None:
    result = keyss("fit", workspace / "a", "-o", tmp_path / "out", *SMALL, "--dry-run")
    assert result.status == 0, result.err
    assert all(re.search(rf"^{word} +", result.out, re.M) for word in ("model", "training", "cost"))
    assert listing(tmp_path) == {}
