"""Scenes and a hidden scene for tests of the command line."""

from __future__ import annotations

from pathlib import Path

import pytest

from cli.harness import SMALL, write_key, write_workspace
from files.scene_files import write_nerfstudio
from keyss.cli import main
from shared import make_once


@pytest.fixture(scope="session")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Scenes `a` and `b`, key files, and the run `hidden`, which hides b in a; read-only."""
    return make_once(tmp_path_factory, "workspace", _make_workspace)


def _make_workspace(folder: Path) -> None:
    write_key(write_workspace(folder) / "wrong.txt", "fedcba9876543210")
    scenes = ("--cover", folder / "a", "--secret", folder / "b", "--key-file", folder / "key.txt")
    assert (
        main(["hide", "--publish", "converted", *map(str, scenes), "-o", str(folder / "hidden"), *SMALL]) == 0
    )


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """A scene in a writable folder."""
    return write_nerfstudio(tmp_path / "b", count=4)
