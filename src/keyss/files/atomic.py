"""Writes that leave either the whole new file or the old one, never a part."""

from __future__ import annotations

import errno
import fcntl
import io
import os
import stat
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

    On any failure the temporary file is removed and `path` is as it was; one that a killed process left is
    used again. Only the owner may read the file (mode 0600): most of what this program writes is a secret, or
    tells of one. Raises OutputError when the system refuses (disk full, no permission, missing folder), and
    when another process is writing the same file.
    """
    if isinstance(path, StandardOutput):
        buffer = io.BytesIO()
        yield buffer
        path.write(buffer.getbuffer())
        return
    path = Path(path)
    temporary = path.with_name(f".{path.name}.unfinished")
    try:
        descriptor = _claim(temporary)
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}") from error
    try:
        with os.fdopen(descriptor, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
            os.replace(temporary, path)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise OutputError(f"cannot write {path}: {error.strerror or error}") from error
        raise


def _claim(path: Path) -> int:
    """A descriptor of an empty file of ours at `path`, locked until it is closed. Raises OSError."""
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
        try:
            found = os.fstat(descriptor)
            if not stat.S_ISREG(found.st_mode) or found.st_uid != os.geteuid() or found.st_nlink != 1:
                if found.st_nlink == 0:  # renamed or removed by its writer since it was opened
                    os.close(descriptor)
                    continue
                raise FileExistsError(errno.EEXIST, f"{path} is in the way", str(path))
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                raise BlockingIOError(errno.EAGAIN, "another process is writing it", str(path)) from error
            try:
                same = os.path.samestat(found, os.stat(path, follow_symlinks=False))
            except FileNotFoundError:
                same = False
            if same:
                os.fchmod(descriptor, 0o600)
                os.ftruncate(descriptor, 0)
                return descriptor
        except OSError:
            os.close(descriptor)
            raise
        os.close(descriptor)


def write_bytes(path: Path | str, data: bytes) -> None:
    """Atomically write `data` to `path`. Raises OutputError."""
    with atomic_write(path) as file:
        file.write(data)
