"""Files and folders as people have them: taken where they can be, else called what they are."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from cli.said import SMALL, Run, Said, assert_refused, listing
from files.scene_files import write_blender, write_colmap, write_nerfstudio


def key(folder: Path) -> tuple[str, Path]:
    return "--key-file", folder / "key.txt"


@pytest.mark.parametrize("inside", ["", "publish"])
def test_a_run_in_place_of_a_model_is_told_its_file(
    keyss: Run, world: Path, tmp_path: Path, inside: str
) -> None:
    run, out = world / "hidden" / inside, tmp_path / "out"
    give = f"found a folder; give {world / 'hidden' / 'publish' / 'model.ply'}"
    assert_refused(keyss("reveal", run, *key(world), "-o", tmp_path / "s.ply"), 4, give)
    assert_refused(keyss("render", run, "--cameras", world / "a", "-o", out), 4, give)
    hide = ("hide", "--cover", world / "a", "--secret", world / "b", *key(world), "-o", out)
    assert_refused(keyss(*hide, "--cover-model", run), 4, give)
    assert listing(tmp_path) == {}


@pytest.mark.parametrize("inside", ["publish/model.ply", "publish", "private", "private/config.json"])
@pytest.mark.parametrize("command", ["evaluate", "audit", "audit --report-only"])
def test_what_lies_in_a_run_is_told_the_run(keyss: Run, world: Path, command: str, inside: str) -> None:
    path = world / "hidden" / inside
    said = keyss(*command.split(), path, *key(world))
    kind = "a folder" if path.is_dir() else "a file"
    assert_refused(said, 4, f"{path}: expected the folder of a run")
    assert f"found {kind} in one; give {world / 'hidden'}" in said.err


def test_a_key_file_in_place_of_a_model_is_not_quoted(keyss: Run, world: Path, tmp_path: Path) -> None:
    (text,) = (world / "key.txt").read_text().split()
    for arguments in (
        ("info", world / "key.txt"),
        ("reveal", world / "key.txt", *key(world), "-o", tmp_path / "s.ply"),
    ):
        said = keyss(*arguments)
        assert_refused(said, 4, "found a file of unknown kind")
        assert text[:3] not in said.err


@contextmanager
def unprivileged() -> Iterator[None]:
    """As somebody whom permissions bind: tests may run as root."""
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
    """A folder that everybody may enter, as `tmp_path` is not, with a key that everybody may read."""
    with tempfile.TemporaryDirectory() as folder:
        os.chmod(folder, 0o755)
        (Path(folder) / "key").write_text("q7Rv2LxT9bWm4KzD")
        yield Path(folder)


@pytest.mark.parametrize("closed", ["", "images", "sparse/0"])
def test_an_unreadable_scene_is_an_input_that_cannot_be_read(
    keyss: Run, open_folder: Path, closed: str
) -> None:
    scene, key = write_colmap(open_folder / "scene"), ("--key-file", open_folder / "key")
    (scene / closed).chmod(0)
    commands = (
        ("fit", scene, "-o", open_folder / "out"),
        ("info", scene),
        ("hide", "--cover", scene, "--secret", scene, *key, "-o", open_folder / "out"),
        ("evaluate", scene, *key),
    )
    for command in commands:
        # Imports all it needs.
        keyss(*[open_folder / "nowhere" if each is scene else each for each in command])
        with unprivileged():
            said = keyss(*command)
        assert_refused(said, 4, str(scene))
        assert "ermission denied" in said.err or (command[0] == "evaluate" and closed)
    (scene / closed).chmod(0o700)


def fitted(keyss: Run, scene: Path, out: Path, *extra: object) -> Said:
    said = keyss("fit", scene, "-o", out, *SMALL, *extra)
    assert said.status == 0, said.err
    assert (out / "model.ply").stat().st_size > 0
    return said


def warnings_of(said: Said) -> list[str]:
    return [line for line in said.err.splitlines() if line.startswith("keyss: warning: ")]


MISSING = {
    "colmap": (write_colmap, "images/01.png", "01.png"),
    "blender": (write_blender, "train/r_1.png", "train/r_1"),
    "nerfstudio": (write_nerfstudio, "images/frame_00001.png", "images/frame_00001.png"),
}


@pytest.mark.parametrize("layout", MISSING)
def test_a_missing_photo_is_named_and_left_out_on_demand(keyss: Run, tmp_path: Path, layout: str) -> None:
    write, path, name = MISSING[layout]
    scene = write(tmp_path / "scene", count=4)
    (scene / path).unlink()
    said = keyss("fit", scene, "-o", tmp_path / "out", *SMALL)
    assert_refused(said, 4, f"1 of 4 photos are missing: {name};")
    assert "--skip-missing" in said.err
    assert not (tmp_path / "out").exists()
    (warning,) = warnings_of(fitted(keyss, scene, tmp_path / "out", "--skip-missing"))
    assert warning.endswith(f"1 of 4 photos are missing, left out: {name}")
    described = keyss("info", scene, "--json")
    assert json.loads(described.out)["train_views"] == {"colmap": 2, "blender": 3, "nerfstudio": 2}[layout]
    assert warnings_of(described) == [warning]
