"""`sweep`: the cells of a specification, each a job, and the tables of what they came to."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import msgspec

from keyss._verbs.asking import Secret
from keyss._verbs.planning import plan
from keyss.core.errors import KeyssError, OutputError
from keyss.files.atomic import write_bytes
from keyss.keys.generation import generate_key
from keyss.keys.key_file import read_key_file
from keyss.keys.master import MasterKey
from keyss.methods import registry
from keyss.rendering import Backend
from keyss.runs.config import PathLike
from keyss.runs.folder import check_not_published
from keyss.sweeps.job import Job, checksum, result_of
from keyss.sweeps.running import PRIVATE, Ended, How, Planned, claimed, make_private, run_all
from keyss.sweeps.spec import SweepSpec, Variant, label, read_spec, variants
from keyss.sweeps.tables import CellNumbers, write_tables

MASTER_KEY = f"{PRIVATE}/master-key.txt"
_CHECK = f"{PRIVATE}/master-key-check.txt"
_CELLS = "cells"


@dataclass(frozen=True)
class Cell:
    """One hiding of a sweep."""

    pair: str
    variant: Variant
    seed: int
    planned: Planned

    @property
    def id(self) -> str:
        return self.planned.folder.name


@dataclass(frozen=True)
class Estimate:
    """What is known of a cell before it runs."""

    cell: Cell
    done: bool
    seconds: float  # on all cores of this machine; 0 for one that is done
    memory: int  # bytes
    refused: str | None  # why it cannot work


@dataclass(frozen=True)
class SweepResult:
    """What became of all cells."""

    ended: tuple[Ended, ...]
    tables: tuple[str, ...]  # names of files in the folder of the sweep

    @property
    def failed(self) -> tuple[Ended, ...]:
        return tuple(each for each in self.ended if each.result is None)


def sweep(
    spec: PathLike,
    out: PathLike,
    *,
    master_key_file: PathLike | None = None,
    jobs: int | None = None,
    ray: str | None = None,
    retries: int = How.retries,
    how: How | None = None,
) -> SweepResult:
    """Run all cells of a specification that are not done, and write the tables of all that are.

    `jobs`: cells at once, among which the cores are divided; by default as many as cores and memory allow.
    `ray`: address of a Ray cluster, or "local". `retries`: how often a cell is tried again that died.
    Keys are derived from a master key and the cells' names: that in `master_key_file`, or one that is made
    in the private part of `out`. `how` replaces `jobs`, `ray` and `retries`. Raises KeyssError and its
    children; a cell that fails is in the result.
    """
    path, out = Path(spec), Path(out)
    check_not_published(out)
    found = read_spec(path)
    master = None if master_key_file is None else Path(master_key_file).absolute()
    if master is not None:
        read_key_file(master)
    cells = list(cells_of(path, found, out, master))
    asked = how or How(jobs, ray, retries)

    def work() -> list[Ended]:
        _check_master(out, master)
        return run_all(f"sweep of {len(cells)} cells", [each.planned for each in cells], asked)

    if not out.exists():  # what else is in one that is there may be for others
        make_private(out)
    ended = claimed(out, work)
    return SweepResult(tuple(ended), tuple(write_tables(out, _numbers(cells, ended))))


def cells_of(path: Path, spec: SweepSpec, out: Path, master: Path | None) -> Iterator[Cell]:
    """All cells, in the order of pairs, methods, choices and seeds; those that are the same come once.

    Reads all data, for its checksums. Raises InputError.
    """
    seen = set()
    key_file = str(master or (out / MASTER_KEY).absolute())
    for pair in spec.pairs:
        for variant in variants(path, spec):
            for seed in spec.seeds:
                options: Any = msgspec.to_builtins(variant.options.with_fit(seed=seed))
                chosen = "".join(f" {name}={value}" for name, value in variant.choices.items())
                job = Job(
                    name=f"{label(pair)} {variant.name}{chosen} seed {seed}",
                    cover=pair.cover,
                    secrets=pair.secrets,
                    cover_model=pair.cover_model,
                    secret_models=pair.secret_models,
                    method=variant.method,
                    options=options,
                    width=spec.width,
                    background=spec.background,
                    skip_missing=spec.skip_missing,
                    min_psnr=spec.min_psnr,
                    device=spec.device,
                    audit=spec.evaluate,
                    master_key_file=key_file,
                )
                name = job.identity({each: checksum(each) for each in job.inputs})
                names = tuple(f"cell/{name}/{index}" for index in range(1, len(pair.secrets) + 1))
                job = replace(job, key_names=names)
                if name not in seen:
                    seen.add(name)
                    yield Cell(label(pair), variant, seed, Planned.of(job, out / _CELLS / name))


def estimates(
    spec: PathLike, out: PathLike, *, master_key_file: PathLike | None = None
) -> Iterator[Estimate]:
    """Of every cell what it will take, from a few steps of it; nothing is written.

    Cells that differ only in their seed take as long as each other. Raises as `sweep` does.
    """
    path, out = Path(spec), Path(out)
    found = read_spec(path)
    known: dict[Any, tuple[float, int, str | None]] = {}
    for cell in cells_of(path, found, out, None if master_key_file is None else Path(master_key_file)):
        done = result_of(cell.planned.folder) is not None
        job = cell.planned.job
        alike = (job.inputs, job.method, repr(cell.variant.options))
        if done:
            yield Estimate(cell, True, 0.0, 0, None)
            continue
        if alike not in known:
            known[alike] = _planned(cell)
        yield Estimate(cell, False, *known[alike])


def _planned(cell: Cell) -> tuple[float, int, str | None]:
    job = cell.planned.job
    models = job.secret_models or (None,) * len(job.secrets)
    has_keys = registry.get(job.method).capabilities.keys
    secrets = [
        Secret(scene, f"key {index}" if has_keys else "", model)
        for index, (scene, model) in enumerate(zip(job.secrets, models, strict=True))
    ]
    try:
        found = plan(
            job.cover,
            secrets,
            method=cell.variant.options.with_fit(seed=cell.seed),
            width=job.width,
            background=job.background,
            skip_missing=job.skip_missing,
            cover_model=job.cover_model,
            device=cast(Backend, job.device),
        )
    except KeyssError as error:
        return 0.0, cell.planned.memory, str(error)
    return found.seconds, found.memory_bytes, None


def _check_master(out: Path, given: Path | None) -> None:
    """Makes a master key where none is given; cells of one sweep have keys of one master key.

    Raises OutputError for another master key than that of the cells which are there.
    """
    own = out / MASTER_KEY
    if given is None and not own.exists():
        write_bytes(own, f"{generate_key(22)}\n".encode())
    check = MasterKey(read_key_file(given or own)[0]).check()
    kept = out / _CHECK
    if not kept.exists():
        write_bytes(kept, check.encode())
    elif read_key_file(kept)[0] != check:
        raise OutputError(
            f"{out} holds cells with keys of another master key: give the same `master_key_file`, or choose "
            "another folder"
        )


def _numbers(cells: Sequence[Cell], ended: Sequence[Ended]) -> list[CellNumbers]:
    return [
        CellNumbers(
            cell.pair,
            cell.variant.name,
            cell.variant.choices,
            cell.seed,
            cell.id,
            each.result.numbers,
        )
        for cell, each in zip(cells, ended, strict=True)
        if each.result is not None
    ]
