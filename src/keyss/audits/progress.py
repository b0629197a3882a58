"""The audit so far, from which an interrupted one resumes, and its progress."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Generic, TypeVar

import msgspec
from torch import Tensor

from keyss.audits.record import AUDIT_FILE, AUDIT_FOLDER, PICTURES, Audit, read_audit
from keyss.core.errors import InputError
from keyss.files.atomic import write_bytes
from keyss.files.images import png_bytes
from keyss.files.reading import read_file
from keyss.progress import Reporter
from keyss.runs.records import write_record

T = TypeVar("T")


@dataclass(frozen=True)
class PartResult(Generic[T]):
    """The result of one part of an audit."""

    section: T  # of `Audit`
    pictures: dict[str, Tensor] = field(default_factory=dict)  # [H, W, 3] uint8 by file name


class PartialAudit:
    """The audit so far, with its pictures, in a folder laid out as a run's; for the same `inputs` only."""

    def __init__(self, folder: Path, begun: Audit, inputs: dict[str, object]) -> None:
        self.folder, self.audit = folder, begun
        self.file = folder / AUDIT_FOLDER / AUDIT_FILE
        self.pictures = self.file.parent / PICTURES
        digest = hashlib.sha256(msgspec.json.encode(inputs, order="sorted")).digest()
        path = folder / "inputs.sha256"
        if not path.exists():
            write_bytes(path, digest)
        elif read_file(path, len(digest)) != digest:
            raise InputError(
                f"{folder}: belongs to an audit with other settings or inputs: "
                "give the same ones, or start again with `overwrite=True`"
            )
        if self.file.exists():
            self.audit = replace(read_audit(folder), run=begun.run)

    def add(self, part: str, result: PartResult[Any]) -> None:
        self.pictures.mkdir(parents=True, exist_ok=True)
        for name, picture in result.pictures.items():
            write_bytes(self.pictures / name, png_bytes(picture))
        write_record(self.file, replace(self.audit, **{part: result.section}))
        self.audit = read_audit(self.folder)


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
