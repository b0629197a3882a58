"""A cell: one plain fit, or one hiding and its measures, in a folder of its own.

| file | what |
| --- | --- |
| `cell.json` | the cell |
| `result.json` | its numbers; there only when it is done |
| `run/` | the results of `keyss fit` or `keyss hide` |

A key is in none of these files.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path

from keyss._version import __version__
from keyss.core.scene import ViewOptions
from keyss.fitting.config import FitConfig
from keyss.methods.base import MethodOptions
from keyss.rendering import Backend
from keyss.runs.files import model_in
from keyss.runs.records import read_record, record_bytes

CELL, RESULT, RUN = "cell.json", "result.json", "run"


@dataclass(frozen=True, kw_only=True)
class Cell:
    """A hiding, or without secrets a plain fit of the cover. Paths are absolute.

    A plain model may be that of another cell: its path is relative to the cell's folder.
    """

    keyss: str = __version__
    name: str  # for people
    cover: str  # a scene, or a model
    secrets: tuple[str, ...] = ()
    models: tuple[str | None, ...] = ()  # plain models of the cover and of each secret
    controls: tuple[str, ...] = ()  # plain models of the cover that some measures compare with
    method: str = ""
    options: MethodOptions | FitConfig
    views: ViewOptions = field(default_factory=ViewOptions)
    min_psnr: float | None = 0.0
    bound: bool = False
    device: Backend = "auto"
    measures: tuple[str, ...] = ()  # beyond those of `keyss hide`
    master_key_file: str | None = None

    @property
    def identity(self) -> str:
        """SHA-256 (hexadecimal) of the version of keyss, the options and the paths of all inputs.

        Neither measures nor the master key count: they are not options of the run in the cell's folder.
        """
        same = replace(self, name="", measures=(), master_key_file=None)
        return hashlib.sha256(record_bytes(same)).hexdigest()

    @property
    def needs(self) -> list[str]:
        """Names of the cells whose models it uses."""
        models = [each for each in (*self.models, *self.controls) if each and not os.path.isabs(each)]
        return [Path(each).parts[1] for each in models]

    def is_stale(self, folder: Path) -> bool:
        """True if its result is older than a file or folder that it reads, or its model has been removed."""
        models = [each for each in self.models if each and os.path.isabs(each)]
        inputs = [self.cover, *self.secrets, *models]
        gone = (folder / RESULT).exists() and model_in(folder / RUN) is None
        return gone or changed_since(folder / RESULT, inputs)


@dataclass(frozen=True, kw_only=True)
class Result:
    """The measured numbers of a finished cell: `result.json`."""

    version: int = 3
    keyss: str = __version__
    seconds: float  # of the attempt that finished it
    numbers: dict[str, float] = field(default_factory=dict)  # everything measured, by names with dots
    notes: dict[str, str] = field(default_factory=dict)  # on measures that were skipped or replaced
    measures: tuple[str, ...] = ()  # of the cell's, those in `numbers`


def earlier_result(cell: Cell, folder: Path) -> Result | None:
    """The result in a cell's folder, which may lack measures; None without one, and if it is stale."""
    if not (folder / RESULT).exists() or cell.is_stale(folder):
        return None
    return read_record(folder / RESULT, Result)


def result_of(cell: Cell, folder: Path) -> Result | None:
    """The result of a finished cell, with all its measures; None if it has to run."""
    result = earlier_result(cell, folder)
    return result if result is not None and {*cell.measures} <= {*result.measures} else None


def changed_since(result: Path, inputs: Iterable[str | Path]) -> bool:
    """True if the file `result` exists and is older than one of the files or folders."""
    times = [os.stat(each).st_mtime for each in inputs if os.path.exists(each)]
    return result.exists() and max(times, default=0.0) > result.stat().st_mtime
