"""What an audit has found so far, kept so that an interrupted one goes on, and how far it is."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torch import Tensor

from keyss.core.errors import InputError
from keyss.files.atomic import write_bytes
from keyss.files.images import png_bytes
from keyss.files.reading import read_file
from keyss.fitting.loop import Reporter
from keyss.runs.files import json_bytes, read_json

PICTURES = "pictures"  # folder in that of the audit
_MAX_PICTURE_BYTES = 1 << 26


@dataclass(frozen=True)
class Found:
    """What a part of an audit returns."""

    sections: dict[str, Any]  # of audit.json
    pictures: dict[str, Tensor] = field(default_factory=dict)  # [H, W, 3] uint8 by file name


class Kept:
    """Finished parts in a folder; `inputs` is what must be the same for them to mean the same."""

    def __init__(self, folder: Path, inputs: dict[str, Any]) -> None:
        self.folder = folder
        digest = hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest()
        path = folder / "inputs.json"
        if not path.exists():
            write_bytes(path, json_bytes({"digest": digest}))
        elif read_json(path) != {"digest": digest}:
            raise InputError(
                f"{folder}: belongs to an audit with other settings or inputs; "
                "give the same ones, or start anew with --overwrite"
            )

    def has(self, part: str) -> bool:
        return (self.folder / f"{part}.json").exists()

    def keep(self, part: str, found: Found) -> None:
        for name, picture in found.pictures.items():
            (self.folder / part).mkdir(exist_ok=True)
            write_bytes(self.folder / part / name, png_bytes(picture))
        written = json_bytes({"sections": found.sections, "pictures": sorted(found.pictures)})
        write_bytes(self.folder / f"{part}.json", written)

    def take(self, part: str) -> tuple[dict[str, Any], dict[str, bytes]]:
        """Sections and pictures (PNG files by name) of a part that was kept."""
        kept = read_json(self.folder / f"{part}.json")
        pictures = {
            name: read_file(self.folder / part / name, _MAX_PICTURE_BYTES) for name in kept["pictures"]
        }
        return kept["sections"], pictures


class Steps:
    """Progress of one part: call it with (done, of how many, at what)."""

    def __init__(self, reporter: Reporter, title: str) -> None:
        self._reporter, self._title, self._total = reporter, title, 0

    def __call__(self, done: int, total: int, at: str = "") -> None:
        if not self._total:
            self._reporter.start(self._title, total, 0)
        self._total = total
        self._reporter.update(done, 0, {})

    def finish(self, complete: bool) -> None:
        if self._total:
            if complete:
                self._reporter.update(self._total, 0, {})
            self._reporter.finish()
