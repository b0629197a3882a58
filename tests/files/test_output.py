"""Result folders: all files or none, and nothing lost of what was there."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from keyss.core import OutputError, UsageError
from keyss.files.atomic import write_bytes
from keyss.files.output import CHECKPOINTS, OutputFolder


def tree(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def failing(error: BaseException) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        path.write_bytes(b"a part")
        raise error

    return write


def test_all_files_appear_and_checkpoints_go(tmp_path: Path) -> None:
    folder = OutputFolder(tmp_path / "a" / "run")
    assert list(tmp_path.iterdir()) == []
    (folder.checkpoints() / "fit").touch()
    folder.fill({"x": partial(write_bytes, data=b"1"), "below/y": partial(write_bytes, data=b"2")})
    assert tree(tmp_path) == {"a/run/x": b"1", "a/run/below/y": b"2"}
    assert {path.name for path in folder.path.iterdir()} == {"x", "below"}


@pytest.mark.parametrize(
    ("error", "raised"),
    [(OSError(28, "No space left"), OutputError), (KeyboardInterrupt(), KeyboardInterrupt)],
)
@pytest.mark.parametrize("there", [True, False])
def test_none_appears_when_one_fails(
    tmp_path: Path, there: bool, error: BaseException, raised: type[BaseException]
) -> None:
    path = tmp_path / "run"
    if there:
        (path / CHECKPOINTS).mkdir(parents=True)
        (path / CHECKPOINTS / "fit").write_bytes(b"state")
        (path / "x").write_bytes(b"old")
    before = tree(tmp_path)
    with pytest.raises(raised):
        OutputFolder(path, overwrite=True).fill({"x": partial(write_bytes, data=b"new"), "y": failing(error)})
    assert tree(tmp_path) == before
    assert path.exists() == there


def test_a_folder_in_use_is_refused(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").touch()
    with pytest.raises(OutputError, match="exists: choose another folder"):
        OutputFolder(tmp_path)
    with pytest.raises(OutputError, match="is not a folder"):
        OutputFolder(tmp_path / "notes.txt")
    with pytest.raises(UsageError, match="give one of them"):
        OutputFolder(tmp_path, overwrite=True, resume=True)
    OutputFolder(tmp_path, overwrite=True)
    OutputFolder(tmp_path, resume=True)


def test_an_interrupted_run_is_continued_or_dropped(tmp_path: Path) -> None:
    (tmp_path / CHECKPOINTS).mkdir()
    (tmp_path / CHECKPOINTS / "fit").touch()
    with pytest.raises(OutputError, match="interrupted run: --resume continues it"):
        OutputFolder(tmp_path)
    assert list(OutputFolder(tmp_path, resume=True).checkpoints().iterdir()) != []
    assert list(OutputFolder(tmp_path, overwrite=True).checkpoints().iterdir()) == []
