"""Atomic writes, lock files, and checks of where output may be written."""

from __future__ import annotations

import errno
import fcntl
import os
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from keyss.core.errors import OutputError, UsageError


@contextmanager
def atomic_write(path: Path | str, mode: int = 0o600) -> Iterator[BinaryIO]:
    """Open a temporary file beside `path`; on success fsync it and rename it to `path`.

    On failure the temporary file is removed and `path` is unchanged; the next write reuses a temporary file
    that a killed process left. Files have `mode`, by default 0600, since most of them are secrets or tell of
    one. Raises OutputError when the system refuses (disk full, no permission, missing folder), and when
    another process is writing the same file.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.unfinished")
    try:
        descriptor = _open_locked(temporary)
    except BlockingIOError as error:
        raise OutputError(f"cannot write {path}: another process is writing it") from error
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}") from error
    status = os.fstat(descriptor)
    if not stat.S_ISREG(status.st_mode) or status.st_uid != os.geteuid() or status.st_nlink != 1:
        os.close(descriptor)
        raise OutputError(f"cannot write {path}: {temporary} is in the way")
    try:
        with os.fdopen(descriptor, "wb") as file:
            os.fchmod(descriptor, mode)
            os.ftruncate(descriptor, 0)
            yield file
            file.flush()
            os.fsync(descriptor)
            os.replace(temporary, path)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise OutputError(f"cannot write {path}: {error.strerror or error}") from error
        raise


def write_bytes(path: Path | str, data: bytes, mode: int = 0o600) -> None:
    """Atomically write `data` to `path`. Raises OutputError."""
    with atomic_write(path, mode) as file:
        file.write(data)


def public_mode() -> int:
    """The mode of files for everybody, as the umask sets it."""
    umask = os.umask(0)
    os.umask(umask)
    return 0o666 & ~umask


def mode_like(source: Path) -> int:
    """The mode of what is made from the file `source`: `public_mode` if others can read that, else 0600."""
    return public_mode() if source.stat().st_mode & stat.S_IROTH else 0o600


@contextmanager
def lock(path: Path) -> Iterator[None]:
    """Hold the lock file `path`, which contains our process id, and remove it afterwards.

    The system releases the lock if the process dies. Raises OutputError, which names the parent of the
    file's folder, when another process holds the lock, or the system refuses.
    """
    try:
        descriptor = _open_locked(path)
    except BlockingIOError as error:
        where = path.parent.parent
        raise OutputError(f"{where}: process {_pid(path)} is at work in this folder") from error
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}") from error
    try:
        os.ftruncate(descriptor, 0)
        os.write(descriptor, str(os.getpid()).encode())
        yield
    finally:
        path.unlink(missing_ok=True)
        os.close(descriptor)


def held_by(path: Path) -> str | None:
    """The id of the process that holds the lock file; None if it is free."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
    except OSError:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return _pid(path)
    finally:
        os.close(descriptor)
    return None


def check_not_an_input(path: Path | str, inputs: Iterable[Path]) -> None:
    """Raise UsageError if `path` is one of the `inputs`, under any name or link."""
    for source in inputs:
        with suppress(OSError):  # one of the two does not exist
            if os.path.samefile(path, source):
                raise UsageError(f"{path} is the input {source}: choose another name for the output")


def check_output_file(path: Path | str, overwrite: bool) -> Path:
    """`path`, if a file may be written there. Raises OutputError if it exists or its folder does not."""
    path = Path(path)
    if path.is_dir():
        raise OutputError(f"{path} is a folder: name the file to write")
    if path.exists() and not overwrite:
        raise OutputError(f"{path} exists: choose another name, or `overwrite=True` to replace it")
    if not path.parent.is_dir():
        raise OutputError(f"cannot write {path}: there is no folder {path.parent}")
    if not os.access(path.parent, os.W_OK):
        raise OutputError(f"cannot write {path}: nothing can be written in {path.parent}")
    return path


def _open_locked(path: Path) -> int:
    """Open or create `path`, locked until the descriptor is closed.

    Raises BlockingIOError while another process holds the lock, OSError otherwise.
    """
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.path.samestat(os.fstat(descriptor), os.stat(path, follow_symlinks=False)):
                return descriptor
        except OSError as error:
            if error.errno != errno.ENOENT:
                os.close(descriptor)
                raise
        os.close(descriptor)  # the previous holder renamed or removed the file: try again


def _pid(path: Path) -> str:
    try:
        text = path.read_bytes()[:20].decode("ascii", "replace").strip()
    except OSError:
        text = ""
    return text if text.isdigit() else "(unknown)"
