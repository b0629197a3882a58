"""Finished parts of an audit, from which an interrupted one resumes, and its progress."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, TypeVar, get_type_hints

import msgspec
from torch import Tensor

from keyss.audits.record import Audit
from keyss.core.errors import InputError
from keyss.files.atomic import write_bytes
from keyss.files.images import png_bytes
from keyss.files.reading import read_file
from keyss.fitting.reporting import Reporter
from keyss.runs.records import read_record, write_record

_MAX_PICTURE_BYTES = 1 << 26

T = TypeVar("T")


@dataclass(frozen=True)
class PartResult(Generic[T]):
    """The result of one part of an audit."""

    section: T  # of `Audit`
    pictures: dict[str, Tensor] = field(default_factory=dict)  # [H, W, 3] uint8 by file name


@dataclass(frozen=True, kw_only=True)
class _FinishedPart(Generic[T]):
    version: int = 1
    section: T
    pictures: tuple[str, ...]


class FinishedParts:
    """Finished parts in a folder; they are valid for the same `inputs` only."""

    def __init__(self, folder: Path, inputs: dict[str, object]) -> None:
        self.folder = folder
        digest = hashlib.sha256(msgspec.json.encode(inputs, order="sorted")).digest()
        path = folder / "inputs.sha256"
        if not path.exists():
            write_bytes(path, digest)
        elif read_file(path, len(digest)) != digest:
            raise InputError(
                f"{folder}: belongs to an audit with other settings or inputs: "
                "give the same ones, or start again with `overwrite=True`"
            )

    def has(self, part: str) -> bool:
        return (self.folder / f"{part}.json").exists()

    def keep(self, part: str, result: PartResult[Any]) -> None:
        for name, picture in result.pictures.items():
            (self.folder / part).mkdir(exist_ok=True, mode=0o700)
            write_bytes(self.folder / part / name, png_bytes(picture))
        kept = _FinishedPart(section=result.section, pictures=tuple(result.pictures))
        write_record(self.folder / f"{part}.json", kept)

    def take(self, part: str) -> tuple[Any, dict[str, bytes]]:
        """Section and pictures (PNG files by name) of a finished part."""
        section = get_type_hints(Audit)[part]
        path = self.folder / f"{part}.json"
        kept: _FinishedPart[Any] = read_record(path, _FinishedPart[section])  # type: ignore[valid-type]
        folder = self.folder / part
        return kept.section, {name: read_file(folder / name, _MAX_PICTURE_BYTES) for name in kept.pictures}


class PartProgress:
    """Progress of one part: call it with the numbers of items done and of all."""

    def __init__(self, reporter: Reporter, title: str) -> None:
        self._reporter, self._title, self._total = reporter, title, 0

    def __call__(self, done: int, total: int) -> None:
        if not self._total:
            self._reporter.start(self._title, total, 0)
        self._total = total
        self._reporter.update(done, 0, {})

    def finish(self, complete: bool) -> None:
        if self._total:
            if complete:
                self._reporter.update(self._total, 0, {})
            self._reporter.finish()
