"""A cell: one plain fit, or one hiding and its measures, in a folder of its own.

| file | what |
| --- | --- |
| `cell.json` | the cell |
| `result.json` | its numbers; there only when it is done |
| `failed.json` | the reason, if the last attempt was refused |
| `log.txt` | the output of its attempts |
| `lock` | held (flock) by the process at work |
| `run/` | the results of `keyss fit` or `keyss hide`, unless the cell names another folder |

The identity of a cell is a SHA-256 over its options, the content of its inputs, and the code. A key is in
none of these files.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import msgspec

from keyss import _version
from keyss._version import __version__
from keyss.core.errors import InputError
from keyss.core.scene import ViewOptions
from keyss.runs.files import MODEL
from keyss.runs.records import read_record

CELL, RESULT, FAILED, LOG, LOCK, RUN = (
    *("cell.json", "result.json", "failed.json", "log.txt", "lock", "run"),
)
# Folders whose code does not affect results; the measures in `many` do.
_OUTSIDE, _MEASURES = ("cli", "demo", "many", "viewer"), ("many", "measures.py")


@dataclass(frozen=True, kw_only=True)
class Cell:
    """A hiding: cover, secrets, options, and where its keys come from. Paths are absolute.

    Without secrets and files, it is a plain fit of the cover. A plain model may be that of another cell
    beside this one: `model_of` gives its relative path.
    """

    version: int = 2
    name: str  # for people
    id: str = ""  # the identity, if the folder has another name
    cover: str  # a scene, or a model
    secrets: tuple[str, ...] = ()  # scenes or models ...
    files: tuple[str, ...] = ()  # ... or any files
    models: tuple[str | None, ...] = ()  # plain models of the cover and of each secret
    controls: tuple[str, ...] = ()  # plain models of the cover that some measures compare with
    method: str = ""
    options: dict[str, Any]  # all of the method's, or of the fit
    views: ViewOptions = field(default_factory=ViewOptions)
    min_psnr: float | None = 0.0
    bound: bool = False
    device: str = "auto"
    measures: tuple[str, ...] = ()  # beyond those of `keyss hide`
    run: str = RUN  # folder of results, relative to the cell's own
    # Where the keys come from: a file for each secret, or names under the key in one file.
    key_files: tuple[str, ...] = ()
    master_key_file: str | None = None
    key_names: tuple[str, ...] = ()

    @property
    def fits(self) -> bool:
        """True for a plain fit."""
        return not self.secrets and not self.files

    @property
    def inputs(self) -> tuple[str, ...]:
        """All files and scenes to read, except keys and the models of other cells."""
        models = (each for each in self.models if each and os.path.isabs(each))
        return (self.cover, *self.secrets, *self.files, *models)

    @property
    def identity(self) -> str:
        """SHA-256 (hexadecimal) of everything that determines the result.

        Keys do not count, nor do names and places of files, except the folder of results and the names of
        hidden files. Raises InputError for an input that cannot be read.
        """

        def content(path: str) -> str:
            return checksum(path) if os.path.isabs(path) else path

        made_of = replace(
            self,
            name="",
            id="",
            cover=content(self.cover),
            secrets=tuple(map(content, self.secrets)),
            files=tuple(f"{Path(each).name} {content(each)}" for each in self.files),
            models=tuple(each and content(each) for each in self.models),
            measures=(),
            key_files=(),
            master_key_file=None,
            key_names=(),
        )
        identity = {"cell": made_of, "code": code_version()}
        return hashlib.sha256(b"keyss/v1/cell" + msgspec.json.encode(identity, order="sorted")).hexdigest()


@dataclass(frozen=True, kw_only=True)
class Result:
    """The measured numbers of a finished cell: `result.json`."""

    version: int = 2
    keyss: str = __version__
    name: str
    seconds: float  # of the attempt that finished it
    published: str  # the model, relative to the cell's folder
    sha256: str  # of that file
    numbers: dict[str, float] = field(default_factory=dict)  # everything measured, by names with dots
    notes: dict[str, str] = field(default_factory=dict)  # reasons to skip a measure, by the same names
    measures: tuple[str, ...] = ()  # of the cell's, those in `numbers`


@dataclass(frozen=True, kw_only=True)
class Failure:
    """Why a cell was refused: `failed.json`."""

    version: int = 2
    message: str


def model_of(cell: str) -> str:
    """The model of the plain fit of this name, relative to the folder of a cell beside it."""
    return f"../{cell}/{RUN}/{MODEL}"


def result_of(folder: Path, measures: tuple[str, ...] = ()) -> Result | None:
    """The result of a cell; None if it is not done, lacks a measure, or its model has been removed."""
    if not (folder / RESULT).exists():
        return None
    result = read_record(folder / RESULT, Result)
    return result if (folder / result.published).exists() and {*measures} <= {*result.measures} else None


def error_of(folder: Path) -> str:
    """Why there is no result."""
    if (folder / FAILED).exists():
        return read_record(folder / FAILED, Failure).message
    return f"its process died repeatedly; see {folder / LOG}"


@cache
def checksum(path: str) -> str:
    """SHA-256 of a file's bytes, or of the names and bytes of all files below a folder, hidden ones left out.

    Links are followed. Each path is read once in a process. Raises InputError, also for a folder that leads
    into itself.
    """
    try:
        if not os.path.isdir(path):
            with open(path, "rb") as file:
                return hashlib.file_digest(file, "sha256").hexdigest()
        digest = hashlib.sha256(b"folder")
        for whole in _files_below(path):
            label = os.fsencode(os.path.relpath(whole, path))
            with open(whole, "rb") as file:
                content = hashlib.file_digest(file, "sha256").digest()
            digest.update(len(label).to_bytes(4, "big") + label + content)
        return digest.hexdigest()
    except OSError as error:
        raise InputError(f"cannot read {error.filename or path}: {error.strerror or error}") from error


def _files_below(folder: str, above: tuple[str, ...] = ()) -> Iterator[str]:
    """The files in `folder` and its subfolders, in the order of their names. Raises OSError."""
    real = os.path.realpath(folder)
    if real in above:
        raise InputError(f"{folder} leads into itself")
    folders = []
    for name in sorted(each for each in os.listdir(folder) if not each.startswith(".")):
        whole = os.path.join(folder, name)
        if os.path.isdir(whole):
            folders.append(whole)
        else:
            yield whole
    for each in folders:
        yield from _files_below(each, (*above, real))


@cache
def code_version() -> str:
    """The version of keyss, and a digest of the code that affects results."""
    root = Path(_version.__file__).parent
    digest = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        name = path.relative_to(root)
        if name.parts[0] not in _OUTSIDE or name.parts == _MEASURES:
            digest.update(f"{name}\0".encode() + hashlib.sha256(path.read_bytes()).digest())
    return f"{__version__} {digest.hexdigest()[:16]}"
