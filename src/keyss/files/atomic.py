"""Writes that leave either the whole new file or the old one, never a part."""

from __future__ import annotations

import io
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from keyss.core.errors import OutputError
from keyss.files.streams import StandardOutput


@contextmanager
def atomic_write(path: Path | str | StandardOutput) -> Iterator[BinaryIO]:
    """Open a temporary file beside `path`; on success fsync it and rename it to `path`.

    What goes to standard output is held in memory until it is whole.

    On any failure the temporary file is removed and `path` is as it was. Raises OutputError when the
    system refuses (disk full, no permission, missing folder).
    """
    if isinstance(path, StandardOutput):
        buffer = io.BytesIO()
        yield buffer
        path.write(buffer.getbuffer())
        return
    path = Path(path)
    try:
        descriptor, temporary = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}") from error
    try:
        with os.fdopen(descriptor, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(temporary, 0o666 & ~umask)
        os.replace(temporary, path)
    except BaseException as error:
        Path(temporary).unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise OutputError(f"cannot write {path}: {error.strerror or error}") from error
        raise


def write_bytes(path: Path | str, data: bytes) -> None:
    """Atomically write `data` to `path`. Raises OutputError."""
    with atomic_write(path) as file:
        file.write(data)
