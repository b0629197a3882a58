"""Folders of several runs, as of `compare` and `reproduce`: told once, and one process at a time."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from keyss.core.errors import OutputError
from keyss.files.atomic import write_bytes
from keyss.files.lock import lock
from keyss.files.reading import read_text
from keyss.keys import generate_key
from keyss.runs.folder import check_not_published
from keyss.runs.records import read_record, write_record

ARGUMENTS = "arguments.json"
_LOCK = ".lock"


@dataclass(frozen=True, kw_only=True)
class Begun:
    """What the first command in a folder was told."""

    version: int = 1
    told: dict[str, Any]
    seed: int


@contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Makes the folder if there is none, and keeps other processes out while the block runs.

    Raises OutputError where another one is at work, and for what is no folder or would be given away.
    """
    check_not_published(folder)
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder} is not a folder: choose another place")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot write {folder}: {error.strerror}") from error
    with lock(folder / _LOCK, folder):
        yield


def begun_before(folder: Path) -> Begun | None:
    """None for a folder with nothing in it. Raises OutputError for one that holds something else."""
    if (folder / ARGUMENTS).exists():
        return read_record(folder / ARGUMENTS, Begun)
    if any(each.name != _LOCK for each in folder.iterdir()):
        raise OutputError(f"{folder} holds something else: choose another folder")
    return None


def begin(folder: Path, begun: Begun) -> None:
    write_record(folder / ARGUMENTS, begun)


def key_in(path: Path) -> str:
    """The key in a file of the folder, which is made once."""
    if not path.exists():
        write_bytes(path, f"{generate_key()}\n".encode())
    return read_text(path).strip()
