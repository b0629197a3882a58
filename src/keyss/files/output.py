"""Where single files may be written."""

from __future__ import annotations

from pathlib import Path

from keyss.core.errors import OutputError


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
