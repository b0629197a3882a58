"""`keyss info`: runs that were interrupted, scenes with several sizes, and what a cover can hold."""

from __future__ import annotations

import re
import signal
from pathlib import Path

import pytest
from PIL import Image

import keyss as library
from channels.lsb.trained_like import trained_like
from cli.harness import SMALL, Run, assert_refused
from files.scene_files import write_nerfstudio
from keyss.files import load_scene, read_model, write_model
from keyss.fitting import FitConfig
from keyss.progress import Reporter


class Stop(Reporter):
    """Ctrl-C after a few steps."""

    def update(self, iteration: int, gaussians: int, numbers: dict[str, float]) -> None:
        if iteration >= 7:
            signal.raise_signal(signal.SIGINT)


def test_interrupted_run(keyss: Run, tmp_path: Path) -> None:
    scene = write_nerfstudio(tmp_path / "scene", count=4)
    with pytest.raises(KeyboardInterrupt):
        library.fit(
            scene, config=FitConfig(iterations=20, max_gaussians=100), out=tmp_path / "run", reporter=Stop()
        )
    result = keyss("info", tmp_path / "run")
    assert result.status == 0, result.err
    assert re.search(r"kind +unfinished fit", result.out)
    assert re.search(r"interrupted after [78] training steps", result.out)
    assert "--resume continues it" in result.out
    refused = keyss("evaluate", tmp_path / "run")
    assert_refused(refused, 4, "found an interrupted one, which `keyss info")


def test_photos_of_several_sizes(keyss: Run, tmp_path: Path) -> None:
    scene = write_nerfstudio(tmp_path / "scene", count=4)
    first = min((scene / "images").iterdir())
    with Image.open(first) as image:
        size = image.size
        half = image.resize((size[0] // 2, size[1] // 2))
    half.save(first)
    out = keyss("info", scene).out
    assert f"{size[0]} x {size[1]}, {size[0] // 2} x {size[1] // 2}" in out
    assert "farthest camera" in out


def test_damaged_photos_are_skipped(keyss: Run, tmp_path: Path) -> None:
    scene = write_nerfstudio(tmp_path / "scene", count=6)
    first, second, *_ = sorted((scene / "images").iterdir())
    first.write_bytes(first.read_bytes()[:40])
    second.write_bytes(second.read_bytes()[:-30])
    result = keyss("info", scene)
    assert result.status == 0, result.err
    assert "2 of 6 photos cannot be read, left out" in result.err
    assert len(load_scene_quietly(scene)) == 4
    refused = keyss("fit", scene, "-o", tmp_path / "run", *SMALL[2:])
    assert refused.status == 4


def load_scene_quietly(scene: Path) -> tuple[object, ...]:
    with pytest.warns(UserWarning, match="left out"):
        return load_scene(scene, skip_missing=True).views


def test_capacity(keyss: Run, tmp_path: Path) -> None:
    write_model(tmp_path / "cover.ply", trained_like(1500))
    plain = keyss("info", tmp_path / "cover.ply").out
    assert "--format" not in plain
    assert all(word in plain for word in ("two corners", "opacities below 0.05", "--capacity", "verify"))
    out = keyss("info", tmp_path / "cover.ply", "--capacity").out
    assert re.search(
        r"--format ply: \d+,\d+ bytes in low bits, a model of about \d+,?\d* Gaussians of SH degree 3 ", out
    )
    for words in ("--format spz: ", "--format sog: ", "--format compressed-ply: ", "--channel colours: "):
        assert words in out
    assert "--publish converted: 5,999,820 bytes" in out
    write_model(tmp_path / "small.spz", trained_like(1500))
    write_model(tmp_path / "decoded.ply", read_model(tmp_path / "small.spz"))
    out = keyss("info", tmp_path / "decoded.ply", "--capacity").out
    assert re.search(r"--format ply: .* bytes in values of the spz file that the cover was decoded from", out)


def test_capacity_is_of_a_model(keyss: Run, workspace: Path) -> None:
    run = workspace / "hidden"
    for folder, cure in ((workspace / "a", "`keyss fit`"), (run, f"such as {run}/publish/model.ply")):
        assert_refused(keyss("info", folder, "--capacity"), 2, f"{folder}: --capacity is of a model")
        assert cure in keyss("info", folder, "--capacity").err


def test_folders_of_a_run(keyss: Run, workspace: Path) -> None:
    run = workspace / "hidden"
    assert_refused(keyss("info", run / "private"), 4, f"a folder in one; give {run}")
    assert_refused(keyss("info", workspace), 4, f"found a folder of runs; give one, such as {run}")


def test_hidden_files(keyss: Run, workspace: Path, tmp_path: Path) -> None:
    write_model(tmp_path / "cover.ply", trained_like(1500))
    (tmp_path / "letter.txt").write_text("a letter")
    cover = ("--cover", tmp_path / "cover.ply", "--key-file", workspace / "key.txt")
    assert keyss("hide", *cover, "--secret-file", tmp_path / "letter.txt", "-o", tmp_path / "run").status == 0
    assert re.search(r"kind +hiding of files", keyss("info", tmp_path / "run").out)
    assert "--format spz: " in keyss("info", tmp_path / "run", "--capacity").out
