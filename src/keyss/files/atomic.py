"""Atomic writes, lock files, and checks of output paths.

On Windows file modes have no effect: files inherit the permissions of their folder.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import BinaryIO

from keyss.core.errors import OutputError, UsageError


def leftovers(path: Path) -> tuple[Path, Path]:
    """The lock and the temporary file of a write to `path`, which a killed process leaves behind."""
    return path.with_name(f".{path.name}.lock"), path.with_name(f".{path.name}.unfinished")


@contextmanager
def atomic_write(path: Path | str, mode: int = 0o600) -> Iterator[BinaryIO]:
    """Open a temporary file beside `path`; on success fsync it and rename it to `path`.

    On failure the temporary file is removed and `path` is unchanged; the next write removes what a killed
    process left behind. The default mode is 0600, since most files are secrets or describe one. Raises
    OutputError on system errors (disk full, no permission, missing folder), and if another process is writing
    the same file.
    """
    path = Path(path)
    locked, temporary = leftovers(path)
    try:
        with lock(locked, path):
            temporary.unlink(missing_ok=True)
            try:
                with open(temporary, "xb", opener=partial(os.open, mode=0o600)) as file:
                    yield file
                    file.flush()
                    os.fsync(file.fileno())
                temporary.chmod(mode)
                os.replace(temporary, path)  # after closing, which Windows needs
            except BaseException:
                temporary.unlink(missing_ok=True)
                raise
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror or error}") from error


def write_bytes(path: Path | str, data: bytes, mode: int = 0o600) -> None:
    """Atomically write `data` to `path`. Raises OutputError."""
    with atomic_write(path, mode) as file:
        file.write(data)


def public_mode() -> int:
    """Permission bits of a public file under the current umask."""
    umask = os.umask(0)
    os.umask(umask)
    return 0o666 & ~umask


def mode_like(source: Path) -> int:
    """Permission bits of a file made from `source`: `public_mode` if others can read that, else 0600."""
    return public_mode() if source.stat().st_mode & stat.S_IROTH else 0o600


@contextmanager
def lock(path: Path, written: Path) -> Iterator[None]:
    """Hold the lock file `path` for the file or folder `written`, and remove it afterwards.

    The system releases the lock if the process dies. Raises OutputError if another process holds the lock,
    and on system errors.
    """
    from filelock import FileLock, Timeout  # slow to import

    held = FileLock(path, timeout=0)
    try:
        held.acquire()
    except Timeout as error:
        raise OutputError(f"cannot write {written}: another process is writing it") from error
    except OSError as error:
        raise OutputError(f"cannot write {written}: {error.strerror or error}") from error
    try:
        yield
    finally:
        with suppress(OSError):  # Windows removes the file when the lock is released
            path.unlink()
        held.release()


def check_not_an_input(path: Path | str, inputs: Iterable[Path]) -> None:
    """Raise UsageError if `path` and one of the `inputs` are the same file, links included."""
    for source in inputs:
        with suppress(OSError):  # either does not exist
            if os.path.samefile(path, source):
                raise UsageError(f"{path} is the input {source}: choose another name for the output")


def check_output_file(path: Path | str, overwrite: bool) -> Path:
    """`path`, if a file can be written there. Raises OutputError if it exists or its folder does not."""
    path = Path(path)
    if path.is_dir():
        raise OutputError(f"{path} is a folder: name the file to write")
    if path.is_symlink() and not path.exists():
        raise OutputError(f"{path} is a link to {os.readlink(path)}, which does not exist: remove it first")
    if path.exists() and not overwrite:
        raise OutputError(f"{path} exists: choose another name, or `overwrite=True` to replace it")
    if not path.parent.is_dir():
        raise OutputError(f"cannot write {path}: there is no folder {path.parent}")
    if not os.access(path.parent, os.W_OK):
        raise OutputError(f"cannot write {path}: {path.parent} is not writable")
    return path
