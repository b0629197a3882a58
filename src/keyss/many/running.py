"""The cells of one folder: run those that are not done in processes, on a cluster, or in this process."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import msgspec
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from keyss import progress
from keyss._processes import how_it_ended
from keyss.core.errors import KeyssError, OutputError
from keyss.files.atomic import lock, write_bytes
from keyss.fitting.config import FitConfig
from keyss.keys.key_file import KEY_LENGTH, generate_key, read_key
from keyss.keys.master import MasterKey
from keyss.many.cell import CELL, FAILED, LOG, Cell, Result, error_of, model_of, result_of
from keyss.many.engines import Cluster, Engine, InThisProcess, Processes, Resources
from keyss.many.measures import check_extras
from keyss.many.performing import plan_of
from keyss.many.worker import REFUSED
from keyss.methods import registry
from keyss.methods.base import MethodOptions, Plan
from keyss.progress import Reporter, clock
from keyss.runs.folder import PRIVATE, check_not_published, make_private
from keyss.runs.records import record_bytes

CELLS = "cells"
MASTER_KEY = f"{PRIVATE}/master-key.txt"
RETRIES = 2  # of a cell whose process died
_CHECK = f"{PRIVATE}/master-key-check.txt"
_BASE_BYTES = 800_000_000  # of a process that has loaded all it needs
_MODEL_COPIES = 12  # of the models it reads, in bytes of their files


@dataclass(frozen=True)
class Outcome:
    """The outcome of a cell."""

    name: str
    folder: Path
    result: Result | None  # None: it failed
    error: str | None  # the reason for a missing result
    skipped: bool = False  # was done before


@dataclass(frozen=True)
class ManyResult:
    """The outcomes of all cells, in their order."""

    outcomes: tuple[Outcome, ...]
    tables: tuple[str, ...] = ()  # names of files in the folder

    @property
    def failed(self) -> tuple[Outcome, ...]:
        return tuple(each for each in self.outcomes if each.result is None)


@contextmanager
def claimed(out: Path, mode: int = 0o700) -> Iterator[None]:
    """Create the folder if necessary, and lock it while the block runs.

    Raises OutputError, also inside a folder to be published.
    """
    check_not_published(out)
    try:
        out.mkdir(parents=True, exist_ok=True, mode=mode)
    except OSError as error:
        raise OutputError(f"cannot write {out}: {error.strerror}") from error
    make_private(out / PRIVATE)
    with lock(out / PRIVATE / "lock"):
        yield


def settle_master_key(out: Path, given: Path | None) -> None:
    """Create a master key if none is given; all cells in a folder have keys of one master key.

    Raises OutputError if existing cells have another master key.
    """
    own = out / MASTER_KEY
    if given is None and not own.exists():
        write_bytes(own, f"{generate_key(KEY_LENGTH)}\n".encode())
    check = MasterKey(read_key(given or own)).check()
    kept = out / _CHECK
    if not kept.exists():
        write_bytes(kept, check.encode())
    elif read_key(kept) != check:
        raise OutputError(
            f"{out} holds results with keys of another master key: give the same `master_key_file`, or "
            "choose another folder"
        )


def run_cells(
    title: str,
    cells: Iterable[tuple[Cell, Path]],
    *,
    jobs: int | None = None,
    ray: str | None = None,
    retries: int = RETRIES,
    reporter: Reporter | None = None,
) -> list[Outcome]:
    """Run all cells that are not done, in a `claimed` folder, and return all outcomes.

    Plain fits come first, as hidings use their models. `reporter`: run all in this process. Raises
    OutputError, BackendError and UsageError.
    """
    every = list(cells)
    before = [result_of(folder, cell.measures) for cell, folder in every]
    due = [each for each, result in zip(every, before, strict=True) if result is None]
    for cell, folder in due:
        make_private(folder)
        (folder / FAILED).unlink(missing_ok=True)  # the next attempt writes its own reason
        write_bytes(folder / CELL, record_bytes(cell))
    if due:
        engine = InThisProcess(reporter) if reporter else _engine(due, jobs, ray)
        try:
            _Run(title, len(every), len(every) - len(due), engine, retries).do(due)
        finally:
            engine.close()
    outcomes = []
    for (cell, folder), skipped in zip(every, before, strict=True):
        result = skipped or result_of(folder, cell.measures)
        error = error_of(folder) if result is None else None
        outcomes.append(Outcome(cell.name, folder, result, error, skipped is not None))
    return outcomes


class _Run:
    """Runs cells, with progress on the standard error stream."""

    def __init__(self, title: str, total: int, skipped: int, engine: Engine, retries: int) -> None:
        console = Console(stderr=True, quiet=progress.level < 0)
        # A reporter in this process prints its own progress.
        shown = console.is_terminal and not isinstance(engine, InThisProcess)
        columns = (TextColumn("{task.description}", markup=False), BarColumn(), TimeElapsedColumn())
        self.bars = Progress(*columns, console=console, disable=not shown)
        self.engine, self.retries, self.total = engine, retries, total
        self.whole = self.bars.add_task(title, total=total, completed=skipped)
        self.ended = skipped
        if skipped:
            self._say(f"{title}: {skipped} of {total} are done already")

    def do(self, due: Sequence[tuple[Cell, Path]]) -> None:
        """Return when each cell is done, refused, or out of retries."""
        fits = [each for each in due if each[0].fits]
        with self.bars:
            for group in (fits, [each for each in due if not each[0].fits]):
                if isinstance(self.engine, InThisProcess):
                    for each in group:
                        self._do(*each)
                elif group:
                    self._do_at_once(group)

    def _do_at_once(self, group: Sequence[tuple[Cell, Path]]) -> None:
        with ThreadPoolExecutor(min(self.engine.jobs, len(group))) as pool:
            futures = [pool.submit(self._do, *each) for each in group]
            try:
                for each in as_completed(futures):
                    each.result()
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                self.engine.close()
                raise

    def _do(self, cell: Cell, folder: Path) -> None:
        for number in range(self.retries + 1):
            bar, since = self.bars.add_task(cell.name, total=None), time.monotonic()
            try:
                status = self.engine.attempt(cell.name, folder, _memory(cell))
                how = how_it_ended(status)
            except ConnectionError as error:
                status, how = -1, f"lost: {error}"
            self.bars.remove_task(bar)
            if self.engine.closed:
                return
            if status == 0:
                return self._end(f"{cell.name}: done in {clock(time.monotonic() - since)}")
            if status == REFUSED:
                return self._end(f"{cell.name}: failed")
            if number < self.retries:
                self._say(f"{cell.name}: its process died ({how}); retrying")
        self._end(f"{cell.name}: its process died ({how}); giving up, see {folder / LOG}")

    def _end(self, line: str) -> None:
        self.ended += 1
        self.bars.advance(self.whole)
        self._say(line)

    def _say(self, line: str) -> None:
        whole = f"[{self.ended}/{self.total}] {line}"
        self.bars.console.print(whole, markup=False, highlight=False, soft_wrap=True)


def _engine(due: Sequence[tuple[Cell, Path]], jobs: int | None, ray: str | None) -> Engine:
    """Raises UsageError and BackendError."""
    resources = Resources.divided(jobs, max(_memory(cell) for cell, _ in due))
    return Processes(resources) if ray is None else Cluster(ray, resources)


def _memory(cell: Cell) -> int:
    """A rough estimate of the memory of a cell's process, in bytes."""
    paths = (Path(each) for each in cell.inputs)
    return _BASE_BYTES + _MODEL_COPIES * sum(each.stat().st_size for each in paths if each.is_file())


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
