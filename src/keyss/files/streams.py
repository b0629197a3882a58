"""Models from standard input and to standard output, which the path `-` names."""

from __future__ import annotations

import sys
from pathlib import Path

from keyss.core.errors import InputError, OutputError, UsageError

STANDARD = "-"
MAX_BYTES = 4 << 30  # 16 million Gaussians of SH degree 3
_CHUNK_BYTES = 1 << 20


def is_standard(path: Path | str) -> bool:
    """True if a path names standard input or output."""
    return str(path) == STANDARD


def read_standard_input(limit: int = MAX_BYTES) -> bytes:
    """All of standard input. Raises InputError for a terminal and for more than `limit` bytes."""
    stream = getattr(sys.stdin, "buffer", None)
    if stream is None or stream.isatty():
        state = "closed" if stream is None else "a terminal"
        raise InputError(f"standard input is {state}: expected a 3DGS model from a pipe or a file")
    data = bytearray()
    try:
        while part := stream.read(_CHUNK_BYTES):
            data += part
            if len(data) > limit:
                raise InputError(f"standard input: expected at most {limit:,} bytes, found more")
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
