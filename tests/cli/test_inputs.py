"""Unexpected files and folders: accepted, or named in the error."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from cli.harness import SMALL, Result, Run, assert_refused, listing, scene_arguments
from files.scene_files import write_blender, write_colmap, write_nerfstudio


def key_argument(folder: Path) -> tuple[str, Path]:
    return "--key-file", folder / "key.txt"


@pytest.mark.parametrize("inside", ["", "publish"])
def test_run_folder_as_model(keyss: Run, workspace: Path, tmp_path: Path, inside: str) -> None:
    run, out = workspace / "hidden" / inside, tmp_path / "out"
    give = f"found a folder; give {workspace / 'hidden' / 'publish' / 'model.ply'}"
    assert_refused(keyss("reveal", run, *key_argument(workspace), "-o", tmp_path / "s.ply"), 4, give)
    assert_refused(keyss("render", run, "--cameras", workspace / "a", "-o", out), 4, give)
    assert_refused(keyss("view", run, "-o", out), 4, give)
    hide = ("hide", *scene_arguments(workspace), "-o", out)
    assert_refused(keyss(*hide, "--cover-model", run), 4, give)
    assert listing(tmp_path) == {}


@pytest.mark.parametrize("inside", ["publish/model.ply", "publish", "private", "private/config.json"])
@pytest.mark.parametrize("command", ["evaluate", "audit"])
def test_path_inside_run(keyss: Run, workspace: Path, command: str, inside: str) -> None:
    path = workspace / "hidden" / inside
    result = keyss(command, path, *key_argument(workspace))
    kind = "a folder" if path.is_dir() else "a file"
    assert_refused(result, 4, f"{path}: expected the folder of a run")
    assert f"found {kind} in one; give {workspace / 'hidden'}" in result.err


def test_info_on_published_model_alone(keyss: Run, workspace: Path, tmp_path: Path) -> None:
    (tmp_path / "publish").mkdir()
    model = tmp_path / "publish" / "model.ply"
    model.write_bytes((workspace / "hidden" / "publish" / "model.ply").read_bytes())
    for folder in (tmp_path, model.parent):
        result = keyss("info", folder, "--json")
        assert json.loads(result.out)["path"] == str(model)


@contextmanager
def unprivileged() -> Iterator[None]:
    """Drop root, whom permissions do not bind."""
    root = os.geteuid() == 0
    if root:
        os.seteuid(65534)
    try:
        yield
    finally:
        if root:
            os.seteuid(0)


@pytest.fixture
def open_folder() -> Iterator[Path]:
    """A folder with a key that other users can read, unlike `tmp_path`."""
    with tempfile.TemporaryDirectory() as folder:
        os.chmod(folder, 0o755)
        (Path(folder) / "key").write_text("q7Rv2LxT9bWm4KzD")
        yield Path(folder)


@pytest.mark.parametrize("closed", ["", "images", "sparse/0"])
def test_unreadable_scene(keyss: Run, open_folder: Path, closed: str) -> None:
    scene, key = write_colmap(open_folder / "scene"), ("--key-file", open_folder / "key")
    (scene / closed).chmod(0)
    commands = (
        ("fit", scene, "-o", open_folder / "out"),
        ("info", scene),
        ("hide", "--cover", scene, "--secret", scene, *key, "-o", open_folder / "out"),
        ("evaluate", scene, *key),
    )
    for command in commands:
        # Import everything before dropping root.
        keyss(*[open_folder / "nowhere" if each is scene else each for each in command])
        with unprivileged():
            result = keyss(*command)
        assert_refused(result, 4, str(scene))
        assert "ermission denied" in result.err or (command[0] == "evaluate" and closed)
    (scene / closed).chmod(0o700)


def fit(keyss: Run, scene: Path, out: Path, *extra: object) -> Result:
    result = keyss("fit", scene, "-o", out, *SMALL, *extra)
    assert result.status == 0, result.err
    assert (out / "model.ply").stat().st_size > 0
    return result


def warning_lines(result: Result) -> list[str]:
    return [line for line in result.err.splitlines() if line.startswith("keyss: warning: ")]


MISSING = {
    "colmap": (write_colmap, "images/01.png", "01.png"),
    "blender": (write_blender, "train/r_1.png", "train/r_1"),
    "nerfstudio": (write_nerfstudio, "images/frame_00001.png", "images/frame_00001.png"),
}


@pytest.mark.parametrize("layout", MISSING)
def test_missing_photo(keyss: Run, tmp_path: Path, layout: str) -> None:
    write, path, name = MISSING[layout]
    scene = write(tmp_path / "scene", count=4)
    (scene / path).unlink()
    result = keyss("fit", scene, "-o", tmp_path / "out", *SMALL)
    assert_refused(result, 4, f"1 of 4 photos are missing: {name};")
    assert "--skip-missing" in result.err
    assert not (tmp_path / "out").exists()
    (warning,) = warning_lines(fit(keyss, scene, tmp_path / "out", "--skip-missing"))
    assert warning.endswith(f"1 of 4 photos are missing, left out: {name}")
    described = keyss("info", scene, "--json")
    assert json.loads(described.out)["train_views"] == {"colmap": 2, "blender": 3, "nerfstudio": 2}[layout]
    assert warning_lines(described) == [warning]
