"""Where single files may be written."""

from __future__ import annotations

import os
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from keyss.core.errors import OutputError, UsageError


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
        raise OutputError(f"{path} exists: choose another name, or `overwrite=True` to replace it")
    if not path.parent.is_dir():
        raise OutputError(f"cannot write {path}: there is no folder {path.parent}")
    return path
