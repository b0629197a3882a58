"""`sweep`: the cells of a specification, and the tables of their results."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path

from keyss.keys.key_file import read_key_file
from keyss.many.folder import CellFolder, Forecast
from keyss.many.running import RETRIES, ManyResult, Outcome
from keyss.many.spec import SweepSpec, read_spec, variants
from keyss.many.tables import CellNumbers, write_tables
from keyss.rendering.orbit import is_model
from keyss.runs.sources import PathLike

# Numbers that differ from run to run, or repeat arguments.
_NO_MEASURES = {"seconds", "seed", "version", "width"}


def sweep(
    spec: PathLike,
    out: PathLike,
    *,
    master_key_file: PathLike | None = None,
    jobs: int | None = None,
    ray: str | None = None,
    retries: int = RETRIES,
    dry_run: bool = False,
) -> ManyResult | Forecast:
    """Run all cells of a specification that are not done, and write the tables of all that are.

    `jobs`: cells at once, among which the cores are divided; by default as many as cores and memory allow.
    `ray`: address of a Ray cluster, or "local". `retries`: of a cell whose process died.
    `dry_run`: only return the plans of the cells. Keys are derived from a master key and the cells' names:
    the one in `master_key_file`, or a new one in the private part of `out`. Raises KeyssError and its
    children; a cell that fails is in the result.
    """
    path = Path(spec)
    found = read_spec(path)
    master = None if master_key_file is None else Path(master_key_file).absolute()
    if master is not None:
        read_key_file(master)
    folder = CellFolder(Path(out), master, found.common)
    rows = _rows(path, found, folder)
    if dry_run:
        return folder.forecast()
    outcomes = folder.run(f"sweep of {len(rows)} cells", jobs=jobs, ray=ray, retries=retries)
    ended = [replace(row, numbers=_numbers(outcomes[place])) for place, row in rows.items()]
    tables = write_tables(folder.out, [row for row in ended if row.numbers])
    return ManyResult(tuple(outcomes[place] for place in rows), tuple(tables))


def _rows(path: Path, spec: SweepSpec, folder: CellFolder) -> dict[Path, CellNumbers]:
    """Add all cells, in the order of pairs, methods, choices and seeds; a row for each, without numbers.

    Scenes without plain models share fits. Reads all data, for its checksums. Raises InputError.
    """
    found: dict[Path, CellNumbers] = {}
    for pair, variant, seed in product(spec.pairs, variants(path, spec), spec.seeds):
        options = variant.options.with_fit(seed=seed)
        sources = [pair.cover, *pair.secrets]
        given = [pair.cover_model, *(pair.secret_models or [None] * len(pair.secrets))]
        models = [
            model if model or is_model(source) else folder.plain(source, config)
            for source, model, config in zip(sources, given, options.fits(len(sources)), strict=True)
        ]
        chosen = "".join(f" {name}={value}" for name, value in variant.choices.items())
        name = f"{pair.label} {variant.name}{chosen} seed {seed}"
        place = folder.hiding(name, sources, options, models, measures=spec.evaluate)
        found.setdefault(place, CellNumbers(pair.label, variant.name, variant.choices, seed, place.name, {}))
    return found


def _numbers(outcome: Outcome) -> dict[str, float]:
    """The measurements of a cell, none if it failed."""
    numbers = outcome.result.numbers if outcome.result else {}
    return {name: value for name, value in numbers.items() if _NO_MEASURES.isdisjoint(name.split("."))}
