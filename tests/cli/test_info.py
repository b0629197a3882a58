"""`keyss info`: runs that were interrupted, scenes with several sizes, and what a cover can hold."""

from __future__ import annotations

import re
import signal
from pathlib import Path

import pytest
from PIL import Image

import keyss as library
from channels.lsb.trained_like import trained_like
from cli.harness import SMALL, Run, assert_refused, write_key
from files.scene_files import write_nerfstudio
from keyss.files import load_scene, read_model, write_model
from keyss.fitting import FitConfig
from keyss.progress import Reporter


class Stop(Reporter):
    """Ctrl-C after a few steps."""

    def update(self, iteration: int, gaussians: int, numbers: dict[str, float]) -> None:
        if iteration >= 7:
            signal.raise_signal(signal.SIGINT)


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def photos(tmp_path: Path) -> list[Path]:
    """Of the scene `scene`."""
    return sorted((write_nerfstudio(tmp_path / "scene", count=6) / "images").iterdir())


def test_interrupted_run(keyss: Run, photos: list[Path]) -> None:
    with pytest.raises(KeyboardInterrupt):
        library.fit("scene", config=FitConfig(iterations=20, max_gaussians=100), out="run", reporter=Stop())
    result = keyss("info run")
    assert result.status == 0, result.err
    assert re.search(r"kind +unfinished fit", result.out)
    assert "--resume continues it" in result.out
    assert_refused(keyss("evaluate run"), 4, "found an interrupted one, which `keyss info run` describes")


def test_photos_of_several_sizes(keyss: Run, photos: list[Path]) -> None:
    with Image.open(photos[0]) as image:
        size = image.size
        half = image.resize((size[0] // 2, size[1] // 2))
    half.save(photos[0])
    out = keyss("info scene").out
    assert f"{size[0]} x {size[1]}, {size[0] // 2} x {size[1] // 2}" in out
    assert "farthest camera" in out


def test_damaged_photos_are_skipped(keyss: Run, photos: list[Path]) -> None:
    photos[0].write_bytes(photos[0].read_bytes()[:40])
    photos[1].write_bytes(photos[1].read_bytes()[:-30])
    result = keyss("info scene")
    assert result.status == 0, result.err
    assert "2 of 6 photos cannot be read, left out" in result.err
    with pytest.warns(UserWarning, match="left out"):
        assert len(load_scene("scene", skip_missing=True).views) == 4
    assert keyss("fit scene -o run", *SMALL[2:]).status == 4


def test_capacity(keyss: Run, tmp_path: Path) -> None:
    write_model(tmp_path / "cover.ply", trained_like(1500))
    plain = keyss("info cover.ply").out
    assert "--format" not in plain
    assert all(word in plain for word in ("two corners", "opacities below 0.05", "--capacity", "verify"))
    out = keyss("info cover.ply --capacity").out
    assert re.search(
        r"--format ply: \d+,\d+ bytes in low bits, a model of about \d+,?\d* Gaussians of SH degree 3 ", out
    )
    for words in ("--format spz: ", "--format sog: ", "--format compressed-ply: ", "--channel colours: "):
        assert words in out
    assert "--publish converted: 5,999,820 bytes" in out
    write_model(tmp_path / "small.spz", trained_like(1500))
    write_model(tmp_path / "decoded.ply", read_model(tmp_path / "small.spz"))
    out = keyss("info decoded.ply --capacity").out
    assert re.search(r"--format ply: .* bytes in values of the spz file that the cover was decoded from", out)


def test_folders_of_runs(keyss: Run, workspace: Path) -> None:
    run, scene = workspace / "hidden", workspace / "a"
    assert_refused(keyss("info", run / "private"), 4, f"a folder in one; give {run}")
    assert_refused(keyss("info", workspace), 4, f"found a folder of runs; give one, such as {run}")
    for folder, cure in ((scene, "`keyss fit`"), (run, f"such as {run}/publish/model.ply")):
        refused = keyss("info --capacity", folder)
        assert_refused(refused, 2, f"{folder}: --capacity is of a model")
        assert cure in refused.err


def test_hidden_files(keyss: Run, tmp_path: Path) -> None:
    write_model(tmp_path / "cover.ply", trained_like(1500))
    write_key(tmp_path / "key")
    assert keyss("hide --cover cover.ply --key-file key --secret-file key -o run").status == 0
    assert re.search(r"kind +hiding of files", keyss("info run").out)
    assert "--format spz: " in keyss("info run --capacity").out
