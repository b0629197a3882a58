"""Files that hold a key."""

from __future__ import annotations

import os
from pathlib import Path

from keyss.core.errors import InputError, OutputError

MAX_FILE_BYTES = 4096


def read_key_file(path: Path) -> tuple[str, int]:
    """The text of a key file without one newline at its end, and the file's mode.

    Raises InputError for a file that holds no key.
    """
    try:
        with path.open("rb") as file:
            mode = os.fstat(file.fileno()).st_mode
            data = file.read(MAX_FILE_BYTES + 1)
    except OSError as error:
        raise InputError(f"{path}: the key file cannot be read: {error.strerror}") from error
    if len(data) > MAX_FILE_BYTES:
        raise InputError(f"{path}: expected a key file of at most {MAX_FILE_BYTES} bytes, found more")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: expected a key in UTF-8, found other bytes") from error
    key = text.removesuffix("\n").removesuffix("\r")
    if not key:
        raise InputError(f"{path}: the key file is empty; `keyss keygen -o FILE` writes a key")
    return key, mode


def write_new_key(path: Path, key: str) -> None:
    """Write a key file that only its owner can read. Raises OutputError where there is anything already."""
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except FileExistsError as error:
        raise OutputError(f"{path} exists, and a key is never replaced: choose another name") from error
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}") from error
    try:
        with os.fdopen(descriptor, "w", encoding="utf-8") as file:
            os.fchmod(descriptor, 0o600)  # whatever the umask
            file.write(f"{key}\n")
            file.flush()
            os.fsync(descriptor)
    except BaseException as error:
        path.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise OutputError(f"cannot write {path}: {error.strerror}") from error
        raise
