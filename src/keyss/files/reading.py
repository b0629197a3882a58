"""Whole files into memory, with errors a person understands."""

from __future__ import annotations

from pathlib import Path

from keyss.core.errors import InputError


def read_file(path: Path, limit: int | None = None) -> bytes:
    """The bytes of a regular file. Raises InputError when it is missing, unreadable or over `limit` bytes."""
    try:
        if not path.is_file():
            raise InputError(f"{path}: expected a file, found {'a folder' if path.is_dir() else 'nothing'}")
        if limit is not None and path.stat().st_size > limit:
            raise InputError(f"{path}: expected at most {limit:,} bytes, found {path.stat().st_size:,}")
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error


def read_text(path: Path, limit: int | None = None) -> str:
    """The text of a UTF-8 file, without its byte order mark. Raises InputError, as on any other bytes."""
    try:
        return read_file(path, limit).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path}: expected UTF-8 text, found byte 0x{error.object[error.start]:02x}"
        ) from error
