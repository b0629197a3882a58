"""What `keyss reproduce` is asked for, and what that comes to: scenes, groups, options, checked."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

from keyss.core.errors import UsageError
from keyss.core.nearest import nearest
from keyss.fitting.config import FitConfig
from keyss.methods import registry
from keyss.methods.base import MethodOptions
from keyss.rendering import Backend
from keyss.rendering.orbit import is_model
from keyss.reproduction.published import PAIRS, TRIPLES
from keyss.reproduction.scenes import BENCHMARK, Group, asked_groups, by_name, check_benchmark, groups_of
from keyss.reproduction.tables import TABLES, Cell, Measure, Table
from keyss.runs.config import PathLike

Scale = Literal["small", "full"]
SMALL: dict[str, int] = {
    "iterations": 1000,
    "max_gaussians": 9000,
    "width": 120,
}  # what a decoder has room in
PRESET = "paper"
RUNS = "runs"


@dataclass(frozen=True)
class PaperTable:
    """A table of the paper that is to be made again: one of `keyss.reproduction.tables.TABLES`.

    At small `scale` the `scenes` (folders of photos) hide each other, with 1,000 steps, 9,000 Gaussians and
    120 pixels of width unless others are given. At full scale they are the paper's in the folder
    `data`, Mip-NeRF 360 and playroom of Deep Blending, with its 30,000 steps and 500,000 Gaussians. `pairs`:
    which hide which, as "COVER,SECRET" or "COVER,SECRET,SECRET" by the names of their folders; by default
    each hides the next, and at full scale as published. `most`: only so many of these.
    """

    table: str
    scenes: Sequence[PathLike] = ()
    scale: Scale = "small"
    data: PathLike | None = None
    pairs: Sequence[str] = ()
    most: int | None = None
    iterations: int | None = None
    max_gaussians: int | None = None
    width: int | None = None  # pixels
    device: Backend = "auto"


@dataclass(frozen=True)
class Setting:
    """Everything that is asked for, checked."""

    table: Table
    scale: Scale
    folders: dict[str, Path]  # of scenes, by name; at full scale in the layout that they come in
    data: Path | None  # at full scale
    groups: tuple[Group, ...]
    sizes: dict[str, int | None]  # iterations, max_gaussians, width
    out: Path
    device: Backend

    @cached_property
    def fit(self) -> FitConfig:
        """Of plain models, without the seed."""
        preset = registry.METHODS["learned"].presets[PRESET].fit
        iterations, most = self.sizes["iterations"], self.sizes["max_gaussians"]
        preset = preset if iterations is None else replace(preset, iterations=iterations)
        return preset if most is None else replace(preset, max_gaussians=most)

    @property
    def work(self) -> list[tuple[Cell, Group]]:
        """Every run with its scenes, pair by pair."""
        return [(cell, group[: cell.secrets + 1]) for group in self.groups for cell in self.table.cells]

    def place(self, cell: Cell, group: Group) -> Path:
        """The folder of a run."""
        return self.out / RUNS / "-".join(group) / cell.name

    def numbers(self, cell: Cell, group: Group, measure: Measure) -> Path:
        """Where a run's numbers lie."""
        return self.out / RUNS / "-".join(group) / f"{cell.name}.{measure}.json"

    def options(self, cell: Cell, seed: int) -> MethodOptions:
        """Those of the paper's preset at this scale."""
        preset = registry.METHODS[cell.method].presets[PRESET].adapted(**cell.changes)
        fit = self.fit
        return preset.with_fit(iterations=fit.iterations, max_gaussians=fit.max_gaussians, seed=seed)


def setting_of(asked: PaperTable, out: Path) -> Setting:
    """What is asked for, with results in `out`.

    Raises UsageError and InputError for what cannot be, and writes nothing.
    """
    table, folders = _table(asked), _folders(asked)
    data = None if asked.data is None else Path(os.path.realpath(asked.data))
    groups = _groups(asked, table, list(folders))
    if data is not None:
        for name in sorted({name for group in groups for name in group}):
            check_benchmark(data, name)
    given = {name: getattr(asked, name) for name in SMALL}
    small = SMALL if data is None else {}
    sizes = {name: small.get(name) if value is None else value for name, value in given.items()}
    setting = Setting(table, asked.scale, folders, data, tuple(groups), sizes, out, asked.device)
    for cell in table.cells:
        setting.options(cell, 0)  # refuses
    return setting


def benchmark_scenes(asked: PaperTable) -> list[str]:
    """Names of the paper's scenes that are needed at full scale. Raises UsageError as `setting_of`."""
    table, folders = _table(asked), _folders(asked)
    if asked.data is None:
        raise UsageError('only scenes of `scale="full"` can be downloaded')
    return sorted({name for group in _groups(asked, table, list(folders)) for name in group})


def _table(asked: PaperTable) -> Table:
    if asked.table not in TABLES:
        near = nearest(asked.table, TABLES)
        meant = f"did you mean {near}?" if near else f"expected one of {', '.join(TABLES)}"
        raise UsageError(f"no table is called {asked.table!r}; {meant}")
    for name in ("most", "width"):
        value = getattr(asked, name)
        if value is not None and value < 1:
            raise UsageError(f"`{name}`: expected at least 1, got {value}")
    return TABLES[asked.table]


def _groups(asked: PaperTable, table: Table, names: Sequence[str]) -> list[Group]:
    """Which scenes hide which. Raises UsageError."""
    if asked.pairs:
        groups = asked_groups(asked.pairs, names, table.secrets)
    elif asked.data is not None:
        groups = list(PAIRS if table.secrets == 1 else TRIPLES)
    else:
        groups = groups_of(names, table.secrets)
    return groups[: asked.most]


def _folders(asked: PaperTable) -> dict[str, Path]:
    """Of scenes, by name. Raises UsageError for scenes that do not go with the scale."""
    if asked.scale == "full":
        if asked.data is None or asked.scenes:
            raise UsageError('`scale="full"` takes the paper\'s scenes from `data`, and no others')
        root = Path(os.path.realpath(asked.data))
        return {name: root / name for name in BENCHMARK}
    if asked.data is not None:
        raise UsageError('`data` is for `scale="full"`: give scenes, or leave it out')
    if any(map(is_model, asked.scenes)):
        raise UsageError("expected scenes, folders of photos: models have none to compare with")
    return by_name(asked.scenes)
