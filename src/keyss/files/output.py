"""Result folders: claimed before work begins, filled at the end with all files or none."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from pathlib import Path

from keyss.core.errors import OutputError, UsageError

CHECKPOINTS = "checkpoint"
_STAGING = ".unfinished"


class OutputFolder:
    """A folder for the results of one run.

    Raises OutputError when `path` holds something already and neither `overwrite` nor `resume` is given;
    nothing is created before `checkpoints` or `fill` is called.
    """

    def __init__(self, path: Path | str, *, overwrite: bool = False, resume: bool = False) -> None:
        self.path = Path(path)
        if overwrite and resume:
            raise UsageError("--overwrite starts anew and --resume continues: give one of them")
        if self.path.is_symlink() or self.path.exists():
            if not self.path.is_dir():
                raise OutputError(f"{self.path} exists and is not a folder")
            names = {entry.name for entry in self.path.iterdir()}
            if names and not (overwrite or resume):
                interrupted = "holds an interrupted run: --resume continues it, --overwrite drops it"
                taken = "exists: choose another folder, or --overwrite to replace its results"
                raise OutputError(f"{self.path} {interrupted if names == {CHECKPOINTS} else taken}")
        self._drop_checkpoints = overwrite

    def checkpoints(self) -> Path:
        """The folder for checkpoints, created; emptied first when the run starts anew."""
        folder = self.path / CHECKPOINTS
        try:
            if self._drop_checkpoints:
                shutil.rmtree(folder, ignore_errors=True)
                self._drop_checkpoints = False
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"cannot create {folder}: {error.strerror}") from error
        return folder

    def fill(self, writers: Mapping[str, Callable[[Path], None]]) -> None:
        """Call each writer with a path to write to, then move all files to their names and drop checkpoints.

        Names may have one folder in them. When a writer fails, none of the files appears, checkpoints
        stay, and a folder that was not there before is gone again. Raises OutputError.
        """
        was_there = self.path.exists()
        staging = self.path / _STAGING
        try:
            shutil.rmtree(staging, ignore_errors=True)
            for name, write in writers.items():
                (staging / name).parent.mkdir(parents=True, exist_ok=True)
                write(staging / name)
            for name in writers:
                (self.path / name).parent.mkdir(parents=True, exist_ok=True)
                os.replace(staging / name, self.path / name)
        except BaseException as error:
            if not was_there:
                shutil.rmtree(self.path, ignore_errors=True)
            if isinstance(error, OSError):
                raise OutputError(f"cannot write to {self.path}: {error.strerror or error}") from error
            raise
        finally:
            shutil.rmtree(staging, ignore_errors=True)
        shutil.rmtree(self.path / CHECKPOINTS, ignore_errors=True)


def check_not_an_input(path: Path | str, inputs: Iterable[Path]) -> None:
    """Raise UsageError if one of the `inputs` would be overwritten, by whatever name or link."""
    for each in inputs:
        with suppress(OSError):  # one of them is not there
            if os.path.samefile(path, each):
                raise UsageError(f"{path} is the input {each}: choose another name for the output")


def check_output_file(path: Path | str, overwrite: bool) -> Path:
    """`path`, if a file may be written there. Raises OutputError when it exists or its folder does not."""
    path = Path(path)
    if path.is_dir():
        raise OutputError(f"{path} is a folder: name the file to write")
    if path.exists() and not overwrite:
        raise OutputError(f"{path} exists: choose another name, or --overwrite to replace it")
    if not path.parent.is_dir():
        raise OutputError(f"cannot write {path}: there is no folder {path.parent}")
    return path
