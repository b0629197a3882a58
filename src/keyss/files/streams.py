"""Standard input and output in place of a model's file, for pipes: what `-` stands for as a path."""

from __future__ import annotations

import io
import sys
from pathlib import Path
from typing import BinaryIO

from keyss.core.errors import InputError, OutputError, UsageError

STANDARD = "-"
MAX_BYTES = 4 << 30  # 16 million Gaussians of SH degree 3
_CHUNK_BYTES = 1 << 20


def is_standard(path: Path | str) -> bool:
    """Whether a path stands for standard input or output."""
    return str(path) == STANDARD


class StandardInput:
    """All that standard input gives, read once; as far as a reader of models is concerned, a `Path`."""

    def __init__(self, limit: int = MAX_BYTES) -> None:
        """Raises InputError for a terminal, for more than `limit` bytes and when the system refuses."""
        stream = getattr(sys.stdin, "buffer", None)
        if stream is None:
            raise InputError(f"{self} is closed: expected a 3DGS model from a pipe or a file")
        if stream.isatty():
            raise InputError(f"{self} is a terminal: expected a 3DGS model from a pipe or a file")
        data = bytearray()
        try:
            while part := stream.read(_CHUNK_BYTES):
                data += part
                if len(data) > limit:
                    raise InputError(f"{self}: expected at most {limit:,} bytes, found more")
        except OSError as error:
            raise InputError(f"cannot read {self}: {error.strerror or error}") from error
        self._data = bytes(data)

    def __str__(self) -> str:
        return "standard input"

    name = "-"

    def is_file(self) -> bool:
        return True

    def is_dir(self) -> bool:
        return False

    def open(self, mode: str) -> BinaryIO:
        """From the beginning; `mode` is "rb"."""
        return io.BytesIO(self._data)


class StandardOutput:
    """Standard output as something to write a whole file to."""

    def __str__(self) -> str:
        return "standard output"

    def check(self) -> None:
        """Raise UsageError for a terminal, OutputError where there is none."""
        if getattr(sys.stdout, "buffer", None) is None:
            raise OutputError(f"{self} is closed: expected a pipe or a file to write the model to")
        if sys.stdout.isatty():
            raise UsageError(f"a model is no text for a terminal: lead {self} to a file or a pipe")

    def write(self, data: memoryview) -> None:
        """All of it at once. Raises OutputError; BrokenPipeError comes through."""
        self.check()
        try:
            sys.stdout.flush()
            sys.stdout.buffer.write(data)
            sys.stdout.buffer.flush()
        except BrokenPipeError:
            raise
        except OSError as error:
            raise OutputError(f"cannot write to {self}: {error.strerror or error}") from error


class MemoryInput(StandardInput):
    """Bytes that are there already, under the name of a file."""

    def __init__(self, name: str, data: bytes) -> None:
        self.name = name
        self._data = data

    def __str__(self) -> str:
        return self.name


class MemoryOutput(StandardOutput):
    """Bytes that are not to be written yet, under the name of a file; `data` is what they are."""

    def __init__(self, name: str) -> None:
        self._name = name
        self.data = b""

    def __str__(self) -> str:
        return self._name

    def write(self, data: memoryview) -> None:
        self.data = bytes(data)
