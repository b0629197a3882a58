"""Opens files and standard streams, with errors that name them."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from keyss.core.errors import InputError, OutputError, UsageError

STANDARD = "-"
MAX_BYTES = 4 << 30  # 16 million Gaussians of SH degree 3
_CHUNK_BYTES = 1 << 20


@contextmanager
def open_input(path: Path) -> Iterator[BinaryIO]:
    """Open a regular file. OSErrors and InputErrors in the block become InputErrors that name the file."""
    try:
        if not path.is_file():  # opening a pipe could block forever
            raise InputError(f"expected a file, found {'a folder' if path.is_dir() else 'nothing'}")
        with path.open("rb") as file:
            yield file
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error


def read_file(path: Path, limit: int | None = None) -> bytes:
    """The bytes of a regular file. Raises InputError if it is missing, unreadable or over `limit` bytes."""
    with open_input(path) as file:
        if limit is not None and path.stat().st_size > limit:
            raise InputError(f"expected at most {limit:,} bytes, found {path.stat().st_size:,}")
        return file.read()


def read_text(path: Path, limit: int | None = None) -> str:
    """The text of a UTF-8 file, without its byte order mark. Raises InputError, also for other encodings."""
    try:
        return read_file(path, limit).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path}: expected UTF-8 text, found byte 0x{error.object[error.start]:02x}"
        ) from error


def as_text(name: str) -> str:
    """A file name with U+FFFD for what is not text: Python represents undecodable bytes by surrogates."""
    return name.encode("utf-8", "surrogateescape").decode("utf-8", "replace")


def is_standard(path: Path | str) -> bool:
    """True if a path names standard input or output."""
    return str(path) == STANDARD


def read_standard_input() -> bytes:
    """All of standard input. Raises InputError for a terminal and for more than MAX_BYTES."""
    stream = getattr(sys.stdin, "buffer", None)
    if stream is None or stream.isatty():
        state = "closed" if stream is None else "a terminal"
        raise InputError(f"standard input is {state}: expected a 3DGS model from a pipe or a file")
    data = bytearray()
    try:
        while part := stream.read(_CHUNK_BYTES):
            data += part
            if len(data) > MAX_BYTES:
                raise InputError(f"standard input: expected at most {MAX_BYTES:,} bytes, found more")
    except OSError as error:
        raise InputError(f"cannot read standard input: {error.strerror or error}") from error
    return bytes(data)


def check_standard_output() -> None:
    """Raise UsageError if standard output is a terminal, OutputError if it is closed."""
    if getattr(sys.stdout, "buffer", None) is None:
        raise OutputError("standard output is closed: expected a pipe or a file to write the model to")
    if sys.stdout.isatty():
        raise UsageError("standard output is a terminal: redirect the model to a file or a pipe")


def write_standard_output(data: bytes) -> None:
    """Write `data` to standard output. Raises what `check_standard_output` does, and BrokenPipeError."""
    check_standard_output()
    try:
        sys.stdout.flush()
        sys.stdout.buffer.write(data)
        sys.stdout.buffer.flush()
    except BrokenPipeError:
        raise
    except OSError as error:
        raise OutputError(f"cannot write to standard output: {error.strerror or error}") from error
