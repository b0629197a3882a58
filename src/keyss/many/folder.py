"""The cells of one folder: add, plan and run them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import msgspec

from keyss.core.errors import KeyssError
from keyss.fitting.config import FitConfig
from keyss.many.cell import Cell, model_of, result_of
from keyss.many.measures import check_extras
from keyss.many.performing import plan_of
from keyss.many.running import CELLS, MASTER_KEY, Outcome, claimed, run_cells, settle_master_key
from keyss.methods import registry
from keyss.methods.base import MethodOptions, Plan


@dataclass(frozen=True)
class CellPlan:
    """A cell before it runs."""

    name: str
    id: str
    done: bool
    plan: Plan | None = None  # None if it is done or refused
    refused: str | None = None  # why it cannot work


@dataclass(frozen=True)
class Forecast:
    """The cells of a folder before they run, in their order."""

    cells: tuple[CellPlan, ...]

    @property
    def plans(self) -> list[Plan]:
        """The plans of the cells to run."""
        return [each.plan for each in self.cells if each.plan is not None]


@dataclass
class CellFolder:
    """Cells by their folders in `out`; equal cells share one."""

    out: Path
    master_key_file: Path | None = None
    common: Mapping[str, Any] = field(default_factory=dict)  # fields of all cells
    cells: dict[Path, Cell] = field(default_factory=dict)

    def plain(self, scene: str, config: FitConfig) -> str:
        """Add the plain fit of a scene; its model, for other cells."""
        size = f"{config.iterations:,} steps, seed {config.seed}"
        shared = {name: value for name, value in self.common.items() if name not in ("min_psnr", "bound")}
        options = msgspec.to_builtins(config)
        name = f"plain model of {Path(scene).name}, {size}"
        return model_of(self.add(Cell(name=name, cover=scene, options=options, **shared)).name)

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
        """Add a hiding; its folder. `sources`: the cover, then the secrets.

        Raises InputError, and BackendError for measures that need packages which are not installed.
        """
        check_extras(measures)
        if models[0] is not None:  # a plain fit of the same folder
            options = options.for_fitted_cover()
        cell = Cell(
            name=name,
            cover=sources[0],
            secrets=tuple(sources[1:]),
            models=tuple(models),
            controls=tuple(controls),
            method=registry.of_options(options).name,
            options=msgspec.to_builtins(options),
            measures=measures,
            **self.common,
        )
        return self.add(cell)

    def add(self, cell: Cell) -> Path:
        """Add a cell, and give it keys of the master key; its folder. Raises InputError."""
        place = self.out / CELLS / cell.identity
        names = tuple(f"cell/{place.name}/{index}" for index, _ in enumerate(cell.secrets, start=1))
        key_file = self.master_key_file or (self.out / MASTER_KEY).absolute()
        self.cells.setdefault(place, replace(cell, master_key_file=str(key_file), key_names=names))
        return place

    def run(self, title: str, **options: Any) -> dict[Path, Outcome]:
        """Run all cells that are not done, with the options of `run_cells`; returns outcomes by folder."""
        with claimed(self.out):
            settle_master_key(self.out, self.master_key_file)
            outcomes = run_cells(title, [(cell, place) for place, cell in self.cells.items()], **options)
        return {each.folder: each for each in outcomes}

    def forecast(self) -> Forecast:
        """The plan of each cell. Writes nothing."""
        known: dict[str, CellPlan] = {}  # of cells that differ in seeds only
        found = []
        for place, cell in self.cells.items():
            own = CellPlan(cell.name, place.name, result_of(place, cell.measures) is not None)
            if not own.done:
                fit = {**cell.options, **cell.options.get("fit", {}), "fit": None, "seed": None}
                alike = repr((cell.inputs, cell.method, fit))
                try:
                    planned = known.get(alike) or replace(own, plan=plan_of(cell, place))
                except KeyssError as error:
                    planned = replace(own, refused=str(error))
                known[alike] = planned
                own = replace(planned, name=own.name, id=own.id)
            found.append(own)
        return Forecast(tuple(found))
