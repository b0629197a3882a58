"""A job: one hiding and its evaluation, in a folder of its own.

| file | what |
| --- | --- |
| `job.json` | what it was told |
| `result.json` | what it came to; there only when it is done, and never replaced |
| `failed.json` | why the last attempt was refused |
| `log.txt` | all that its attempts said |
| `key-check.txt` | by what the key of a batch's key file is known again |
| `lock` | held (flock) by the process that is at work |
| `run/` | the folder that `keyss hide` writes, unless the job names another |

The name of the folder is a SHA-256 over what the job comes from: its configuration, the content of the files
that it reads, and the code. A key is in none of these files.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import msgspec

from keyss import _version
from keyss._version import __version__
from keyss.core.errors import InputError
from keyss.runs.records import read_record

JOB, RESULT, FAILED, LOG, KEY_CHECK, LOCK, RUN = (
    "job.json",
    "result.json",
    "failed.json",
    "log.txt",
    "key-check.txt",
    "lock",
    "run",
)
# What cannot change a result: how it is asked for, started and shown.
_OUTSIDE = ("cli", "demo", "report", "sweeps", "viewer")


@dataclass(frozen=True, kw_only=True)
class Job:
    """What is to be hidden in what, how, and with which keys. Paths are absolute."""

    version: int = 1
    name: str  # for people
    cover: str  # a scene, or a model
    secrets: tuple[str, ...] = ()  # scenes or models ...
    files: tuple[str, ...] = ()  # ... or any files
    cover_model: str | None = None
    secret_models: tuple[str, ...] = ()
    method: str
    options: dict[str, Any]  # all of the method's
    width: int | None = None
    background: tuple[float, float, float] | None = None
    skip_missing: bool = False
    min_psnr: float = 20.0
    device: str = "auto"
    audit: tuple[str, ...] = ()  # parts of an audit to measure besides
    run: str = RUN  # folder of results, as seen from the job's own
    # Where the keys come from: a file for each secret, or names under the key in one file.
    key_files: tuple[str, ...] = ()
    master_key_file: str | None = None
    key_names: tuple[str, ...] = ()

    @property
    def inputs(self) -> tuple[str, ...]:
        """All files and scenes that are read, but for keys."""
        models = (self.cover_model,) if self.cover_model else ()
        return (self.cover, *self.secrets, *self.files, *models, *self.secret_models)

    def identity(self, checksums: Mapping[str, str]) -> str:
        """SHA-256, in hexadecimal, over all that the result follows from.

        `checksums`: of `inputs`. Neither names nor places of files count, but for the folder of results; nor
        keys.
        """

        def content(path: str) -> str:
            return checksums[path]

        made_of = replace(
            self,
            name="",
            cover=content(self.cover),
            secrets=tuple(map(content, self.secrets)),
            # The name of a hidden file is hidden with it.
            files=tuple(f"{Path(each).name} {content(each)}" for each in self.files),
            cover_model=self.cover_model and content(self.cover_model),
            secret_models=tuple(map(content, self.secret_models)),
            key_files=(),
            master_key_file=None,
            key_names=(),
        )
        told = {"job": made_of, "code": code_version()}
        return hashlib.sha256(b"keyss/v1/job" + msgspec.json.encode(told, order="sorted")).hexdigest()


@dataclass(frozen=True, kw_only=True)
class Result:
    """What a job came to."""

    version: int = 1
    keyss: str = __version__
    name: str
    seconds: float  # of the attempt that ended it
    published: str  # the published model, as seen from the job's folder
    sha256: str  # of that file
    numbers: dict[str, float] = field(default_factory=dict)  # all that was measured, by names with dots


@dataclass(frozen=True, kw_only=True)
class Failure:
    """Why a job was refused."""

    version: int = 1
    status: int  # exit status of the command line for this error
    message: str


def result_of(folder: Path) -> Result | None:
    """Of a job that is done; None for one that is not, or whose published model has been removed since."""
    if not (folder / RESULT).exists():
        return None
    result = read_record(folder / RESULT, Result)
    return result if (folder / result.published).exists() else None


def failure_of(folder: Path) -> Failure | None:
    """Of a job that was refused."""
    return read_record(folder / FAILED, Failure) if (folder / FAILED).exists() else None


@cache
def checksum(path: str) -> str:
    """SHA-256 of a file's bytes, or of the names and bytes of all files below a folder, hidden ones left out.

    Links are what they lead to. Of one path it is computed once in a process. Raises InputError, also for a
    folder that leads into itself.
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
    """In an order that the names decide. Raises OSError."""
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
    """The version of keyss, and a digest of all of its code that a result can depend on."""
    root = Path(_version.__file__).parent
    digest = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        name = path.relative_to(root)
        if name.parts[0] not in _OUTSIDE:
            digest.update(f"{name}\0".encode() + hashlib.sha256(path.read_bytes()).digest())
    return f"{__version__} {digest.hexdigest()[:16]}"
