"""Reading files, with errors that name the file."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from keyss.core.errors import InputError


@contextmanager
def open_input(path: Path) -> Iterator[BinaryIO]:
    """Open a regular file. Any OSError or InputError in the block becomes an InputError that names it."""
    try:
        if not path.is_file():  # opening a pipe could block for ever
            raise InputError("expected a file, but there is no such file")
        with path.open("rb") as file:
            yield file
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from error


def read_file(path: Path, limit: int | None = None) -> bytes:
    """The bytes of a regular file. Raises InputError if it is missing, unreadable or over `limit` bytes."""
    try:
        if not path.is_file():
            raise InputError(f"{path}: expected a file, found {'a folder' if path.is_dir() else 'nothing'}")
        if limit is not None and path.stat().st_size > limit:
            raise InputError(f"{path}: expected at most {limit:,} bytes, found {path.stat().st_size:,}")
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error


def read_text(path: Path, limit: int | None = None) -> str:
    """The text of a UTF-8 file, without its byte order mark. Raises InputError, also for other encodings."""
    try:
        return read_file(path, limit).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path}: expected UTF-8 text, found byte 0x{error.object[error.start]:02x}"
        ) from error
