"""The cells of one folder: plain fits, hidings that use their models, and their outcomes."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from keyss.core import KeyssError, OutputError
from keyss.files import write_bytes
from keyss.fitting import FitConfig
from keyss.keys import MasterKey, generate_key, read_key
from keyss.keys.key_file import KEY_LENGTH
from keyss.lab.audits.comparison_measures import check_extras
from keyss.lab.many.cell import RUN, Cell, plan_of, result_of, run_cell
from keyss.lab.many.engine import claim_folder, engine
from keyss.lab.many.result_tables import CellNumbers
from keyss.methods import MethodOptions, registry
from keyss.methods.base import Plan
from keyss.progress import Reporter
from keyss.runs.files import MODEL
from keyss.runs.folder import PRIVATE

CELLS = "cells"
MASTER_KEY = f"{PRIVATE}/master-key.txt"
_CHECK = f"{PRIVATE}/master-key-check.txt"
_NO_MEASURES = {"seconds", "seed", "version", "width"}


@dataclass(frozen=True)
class Outcome:
    """The outcome of a run."""

    name: str
    folder: Path
    result: Any = None
    error: str | None = None  # the reason for a missing result
    skipped: bool = False  # True if it was finished before

    def row(self, labels: Mapping[str, Any], scenes: Sequence[str], seed: int) -> CellNumbers:
        """The cell for tables, without times and arguments."""
        numbers = {
            name: value
            for name, value in self.result.numbers.items()
            if _NO_MEASURES.isdisjoint(name.split("."))
        }
        return CellNumbers(labels=labels, scenes=scenes, seed=seed, cell=self.folder.name, numbers=numbers)


@dataclass(frozen=True)
class ManyResult:
    """The outcomes of all runs, in their order."""

    outcomes: tuple[Outcome, ...]
    tables: tuple[str, ...] = ()  # names of files in the folder

    @property
    def errors(self) -> dict[str, str]:
        """Errors of failed runs, by name."""
        return {each.name: each.error for each in self.outcomes if each.error is not None}


@dataclass(frozen=True)
class Forecast:
    """The cells of a folder before they run, by their folders, in order."""

    names: Mapping[Path, str]
    plans: Mapping[Path, Plan]  # cells to run
    refused: Mapping[Path, str]  # reasons why cells cannot run


def check_master_key(out: Path, given: Path | None) -> None:
    """Create a master key if none is given. Raises OutputError if existing results have another one."""
    own, kept = out / MASTER_KEY, out / _CHECK
    if given is None and not own.exists():
        write_bytes(own, f"{generate_key(KEY_LENGTH)}\n".encode())
    check = MasterKey(read_key(given or own)).check()
    if not kept.exists():
        write_bytes(kept, check.encode())
    elif read_key(kept) != check:
        raise OutputError(
            f"{out} holds results with keys of another master key: give the same `master_key_file`, or "
            "choose another folder"
        )


@dataclass
class CellFolder:
    """Cells by their folders in `out`; equal cells share a folder."""

    out: Path
    master_key_file: Path | None = None
    common: Mapping[str, Any] = field(default_factory=dict)  # fields of all cells
    cells: dict[Path, Cell] = field(default_factory=dict)

    def plain(self, scene: str, config: FitConfig) -> str:
        """Add the plain fit of a scene; returns its model, relative to the folder of another cell."""
        name = f"plain model of {Path(scene).name}, {config.iterations:,} steps, seed {config.seed}"
        shared = {each: self.common[each] for each in ("views", "device")}
        return f"../{self._add(Cell(name=name, cover=scene, options=config, **shared)).name}/{RUN}/{MODEL}"

    def hiding(
        self,
        name: str,
        sources: Sequence[str],
        options: MethodOptions,
        models: Sequence[str | None],
        *,
        measures: tuple[str, ...] = (),
        controls: Sequence[str] = (),
    ) -> Path:
        """Add a hiding; returns its folder. `sources`: the cover, then the secrets.

        Raises BackendError if packages for the measures are not installed.
        """
        check_extras(measures)
        cell = Cell(
            name=name,
            cover=sources[0],
            secrets=tuple(sources[1:]),
            models=tuple(models),
            controls=tuple(controls),
            method=registry.of_options(options).name,
            options=options,
            measures=measures,
            **self.common,
        )
        return self._add(cell)

    def _add(self, cell: Cell) -> Path:
        place = self.out / CELLS / cell.identity
        key_file = self.master_key_file or (self.out / MASTER_KEY).absolute()
        self.cells.setdefault(place, replace(cell, master_key_file=str(key_file)))
        return place

    def run(
        self, ray: str | None = None, cores: int = 1, reporter: Reporter | None = None
    ) -> dict[Path, Outcome]:
        """Run all unfinished cells, plain fits first; returns outcomes by folder.

        The arguments are those of `engine`. Raises KeyssError for errors that concern all cells.
        """
        found: dict[Path, Outcome] = {}
        with claim_folder(self.out):
            check_master_key(self.out, self.master_key_file)
            for folder, cell in self.cells.items():
                if (result := result_of(cell, folder)) is not None:
                    found[folder] = Outcome(cell.name, folder, result, skipped=True)
                elif cell.is_stale(folder):
                    shutil.rmtree(folder)
            if len(found) == len(self.cells):
                return found
            with engine(ray, cores, reporter) as run:
                for hides in (False, True):
                    due = {}
                    for folder, cell in self.cells.items():
                        if folder in found or bool(cell.secrets) is not hides:
                            continue
                        needed = (found[folder.with_name(each)].error for each in cell.needs)
                        if reason := next(filter(None, needed), None):
                            found[folder] = Outcome(cell.name, folder, error=reason)
                        else:
                            due[folder] = cell
                    for folder, result, error in run(run_cell, due):
                        found[folder] = Outcome(self.cells[folder].name, folder, result, error)
        return {folder: found[folder] for folder in self.cells}

    def forecast(self) -> Forecast:
        """The plan of each cell. Writes nothing."""
        plans, refused = {}, {}
        for place, cell in self.cells.items():
            try:
                if result_of(cell, place) is None:
                    plans[place] = plan_of(cell, place)
            except KeyssError as error:
                refused[place] = str(error)
        return Forecast({place: cell.name for place, cell in self.cells.items()}, plans, refused)
