"""`reproduce`: a table of the paper, run again and laid beside its figures."""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import product
from pathlib import Path
from statistics import fmean
from typing import Any

from keyss.core.errors import UsageError
from keyss.core.nearest import did_you_mean
from keyss.core.scene import ViewOptions
from keyss.files.atomic import write_bytes
from keyss.fitting.reporting import Reporter
from keyss.many.cell import Result, result_of
from keyss.many.folder import CellFolder, Forecast
from keyss.many.paper import scenes as paper
from keyss.many.paper.layout import Reproduction, laid_out, markdown
from keyss.many.paper.published import PAIRS, TRIPLES
from keyss.many.paper.scenes import Group, groups_of, link, parsed_groups
from keyss.many.paper.tables import SSIM_WEIGHT, TABLES, Run, Table
from keyss.methods import registry
from keyss.methods.base import MethodOptions
from keyss.progress import reporter as default_reporter
from keyss.rendering import Backend
from keyss.rendering.orbit import is_model
from keyss.runs.records import write_record
from keyss.runs.sources import PathLike

_MEASURES = ("pruning.", "rendering.", "sinkhorn.")
SMALL = {"iterations": 1000, "max_gaussians": 9000, "width": 120}


def reproduce(
    table: str,
    scenes: Sequence[PathLike] = (),
    *,
    data: PathLike | None = None,
    download: bool = False,
    pairs: Sequence[str] = (),
    most: int | None = None,
    iterations: int | None = None,
    max_gaussians: int | None = None,
    width: int | None = None,
    seed: int = 0,
    device: Backend = "auto",
    out: PathLike,
    dry_run: bool = False,
    reporter: Reporter | None = None,
) -> Reproduction | Forecast:
    """Reproduce a table of the paper, one of `keyss.many.paper.tables.TABLES`.

    The `scenes` (folders of photos) hide each other, with 1,000 steps, 9,000 Gaussians and 120 pixels of
    width unless others are given. With `data` they are the paper's in that folder, Mip-NeRF 360 and playroom
    of Deep Blending, with its 30,000 steps and 500,000 Gaussians; `download` fetches those that are missing.
    `pairs`: which hide which, as "COVER,SECRET" or "COVER,SECRET,SECRET" by the names of their folders; by
    default each hides the next, and the paper's as published. `most`: only so many of these.

    `out` (a folder) gets `TABLE.json` and `TABLE.md`, and the cells, which tables in one folder share. Cells
    that are done are skipped. `dry_run`: only return their plans. The result lists runs that failed.
    Raises KeyssError and its children for impossible scenes and arguments; Interrupted.
    """
    if table not in TABLES:
        raise UsageError(f"no table is called {table!r}; {did_you_mean(table, TABLES)}")
    for name, value in (("most", most), ("width", width)):
        if value is not None and value < 1:
            raise UsageError(f"`{name}`: expected at least 1, got {value}")
    wanted, paths = TABLES[table], _paths(scenes, data)
    groups = _groups(wanted, list(paths), pairs, data is not None)[:most]
    names = sorted({name for group in groups for name in group})
    small = SMALL if data is None else {}
    given = {"iterations": iterations, "max_gaussians": max_gaussians, "width": width}
    sizes = {name: small.get(name) if value is None else value for name, value in given.items()}
    changes: dict[str, Any] = {"seed": seed, "ssim_weight": SSIM_WEIGHT}
    changes |= {name: size for name, size in sizes.items() if size is not None and name != "width"}
    options = {run.name: _options(run).with_fit(**changes) for run in wanted.runs}
    if data is not None and download:
        paper.download(names, Path(data))
    with _linked(paths, names, data, None if dry_run else Path(out).absolute() / "scenes") as linked:
        folder = CellFolder(Path(out), common={"views": ViewOptions(sizes["width"]), "device": device})
        kept = replace(folder, cells={})
        places: dict[tuple[str, Group], Path] = {}
        fit = options["keyss"].fit
        for group, run in product(groups, wanted.runs):
            own, sources = kept if run.kept else folder, [linked[each] for each in group[: run.secrets + 1]]
            models = [own.plain(source, fit) for source in sources]
            title = f"{run.name}, {'-'.join(group)}"
            place = own.hiding(title, sources, options[run.name], models, measures=wanted.measures)
            places[run.name, group] = place
        if dry_run:
            return folder.forecast()
        outcomes = folder.run(f"table {table}", reporter=reporter or default_reporter())
    numbers: dict[str, list[dict[str, float]]] = {run.name: [] for run in wanted.runs}
    for (name, _), place in places.items():
        if (result := result_of(place, wanted.measures)) is not None:
            numbers[name].append(_numbers(result))
    found = laid_out(
        wanted,
        numbers,
        ["-".join(group) for group in groups],
        covers=[] if data is None else [group[0] for group in groups],
        arguments={**sizes, "seed": seed},
        failures={each.name: each.error for each in outcomes.values() if each.error},
    )
    write_record(folder.out / f"{table}.json", found)
    write_bytes(folder.out / f"{table}.md", markdown(found).encode())
    return found


def _options(run: Run) -> MethodOptions:
    """The paper's settings, except the changes of the run."""
    design: dict[str, Any] = {"design": "published"} if run.method == "keyss" else {}
    return replace(registry.get(run.method).options.preset("full"), **{**design, **run.changes})


def _paths(scenes: Sequence[PathLike], data: PathLike | None) -> dict[str, str]:
    """Folders of scenes, by name. Raises UsageError."""
    if data is not None:
        if scenes:
            raise UsageError("`data` takes the paper's scenes: leave out the others")
        return {name: os.path.realpath(Path(data) / name) for name in paper.BENCHMARK}
    if any(map(is_model, scenes)):
        raise UsageError("expected scenes, folders of photos: models have none to compare with")
    found: dict[str, str] = {}
    for each in map(os.path.realpath, scenes):
        name = os.path.basename(each)
        if found.setdefault(name, each) != each:
            raise UsageError(f"expected scenes of different names, got two that are called {name}")
    return found


def _groups(table: Table, names: Sequence[str], pairs: Sequence[str], published: bool) -> Sequence[Group]:
    """Which scenes hide which. Raises UsageError."""
    if pairs:
        return parsed_groups(pairs, names, table.secrets)
    if published:
        return PAIRS if table.secrets == 1 else TRIPLES
    return groups_of(names, table.secrets)


@contextmanager
def _linked(
    paths: Mapping[str, str], names: Sequence[str], data: PathLike | None, into: Path | None
) -> Iterator[Mapping[str, str]]:
    """Scenes that have the photos that count; `into` None: they are gone afterwards."""
    if data is None:
        yield paths
        return
    with tempfile.TemporaryDirectory() as temporary:
        target = into or Path(os.path.realpath(temporary))
        yield {name: str(link(Path(data), name, target)) for name in names}


def _numbers(result: Result) -> dict[str, float]:
    """The numbers of a cell, by the names of the paper's figures."""
    numbers = result.numbers
    # Measures name theirs as the paper does.
    found = {name.partition(".")[2]: each for name, each in numbers.items() if name.startswith(_MEASURES)}
    secrets = [each for name, each in numbers.items() if re.fullmatch(r"secrets\.\d+\.psnr", name)]
    found |= {f"secret {number}": psnr for number, psnr in enumerate(secrets, start=1)}
    cover, secret = numbers["cover.psnr"], fmean(secrets)
    found |= {"cover": cover, "secret": secret, "mean of both": (cover + secret) / 2}
    # Through the decoder of the first secret.
    wrong = {"cover": "wrong_key.vs_cover.mean", "secret": "wrong_key.vs_secrets.1.mean"}
    return found | {f"wrong key, {role}": numbers[name] for role, name in wrong.items() if name in numbers}
