"""A small world to run the command line in."""

from __future__ import annotations

from pathlib import Path

import pytest

from cli.said import SMALL
from files.scene_files import write_blender, write_nerfstudio
from keyss.cli import main
from shared import made_once


@pytest.fixture(scope="session")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with scenes `a` and `b`, a key file, and `hidden`: b hidden in a; tests must not change it."""
    return made_once(tmp_path_factory, "world", _make_world)


def _make_world(folder: Path) -> None:
    write_blender(folder / "a", count=3, channels=3)
    write_nerfstudio(folder / "b", count=4)
    (folder / "key.txt").write_text("q7Rv2LxT9bWm4KzD\n")
    (folder / "key.txt").chmod(0o600)
    (folder / "wrong.txt").write_text("fedcba9876543210\n")
    arguments = [
        "--publish",
        "any",
        "--cover",
        folder / "a",
        "--secret",
        folder / "b",
        "--key-file",
        folder / "key.txt",
    ]
    status = main(["hide", *map(str, arguments), "-o", str(folder / "hidden"), *SMALL])
    assert status == 0
