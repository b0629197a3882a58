"""`reproduce`: run a table of the paper on its scenes or others, and compare the figures."""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from statistics import fmean
from typing import Any

from keyss.core import UsageError, ViewOptions
from keyss.core.errors import did_you_mean
from keyss.files import write_bytes
from keyss.lab.many.benchmark_scenes import BENCHMARK, download_scenes, link_scene
from keyss.lab.many.cell_folder import CellFolder, Forecast
from keyss.lab.many.option_changes import with_changes
from keyss.lab.many.paper import PAPER, Group, Reproduction, Run, figure_rows, judge_claim, reproduction_text
from keyss.lab.many.result_tables import write_scene_tables
from keyss.methods import MethodOptions, registry
from keyss.progress import Reporter
from keyss.rendering import Backend
from keyss.rendering.orbit import is_model
from keyss.runs import write_record
from keyss.runs.files import PathLike

SMALL = {"iterations": 1000, "max_gaussians": 9000, "width": 120}
SSIM_WEIGHT = 0.5  # D-SSIM weight of the loss, also for plain models


def reproduce(
    table: str,
    scenes: Sequence[PathLike] = (),
    *,
    data: PathLike | None = None,
    download: bool = False,
    pairs: Sequence[str] = (),
    iterations: int | None = None,
    max_gaussians: int | None = None,
    width: int | None = None,
    seeds: Sequence[int] = (0,),
    device: Backend = "auto",
    out: PathLike,
    dry_run: bool = False,
    reporter: Reporter | None = None,
) -> Reproduction | Forecast:
    """Reproduce a table of the paper, one of `keyss.lab.many.paper.PAPER.tables`.

    The `scenes` (folders of photos) hide each other, by default with 1,000 steps, 9,000 Gaussians and a width
    of 120 pixels. `data`: a folder with the paper's scenes (Mip-NeRF 360, and playroom of Deep Blending), run
    with the paper's 30,000 steps and 500,000 Gaussians; `download` fetches missing ones. `pairs`: covers and
    secrets, as "COVER,SECRET" or "COVER,SECRET,SECRET" by the names of their folders; by default each scene
    hides the next, and the paper's are paired as published.

    `out` (a folder) gets `TABLE.json`, `.md`, `.csv` and `.tex` (PSNR, SSIM and LPIPS per scene, with
    standard deviations over `seeds`), and the cells, which tables in one folder share. Finished cells are
    skipped. `dry_run`: only return their plans. The result lists failed runs. Raises KeyssError for
    impossible scenes and arguments; KeyboardInterrupt.
    """
    if table not in PAPER.tables:
        raise UsageError(f"no table is called {table!r}; {did_you_mean(table, PAPER.tables)}")
    if width is not None and width < 1:
        raise UsageError(f"`width`: expected at least 1, got {width}")
    spec = PAPER.tables[table]
    paths = _paths(scenes) if data is None else dict.fromkeys(BENCHMARK, "")
    if data is not None and scenes:
        raise UsageError("`data` takes the paper's scenes: leave out the others")
    default = spec.groups if data is not None else None
    groups = groups_of(list(paths), spec.secrets, pairs, default)
    given = {"iterations": iterations, "max_gaussians": max_gaussians, "width": width}
    small = SMALL if data is None else {}
    sizes = {name: small.get(name) if value is None else value for name, value in given.items()}
    fit = {"iterations": sizes["iterations"], "max_gaussians": sizes["max_gaussians"]}
    changes: dict[str, Any] = {name: value for name, value in fit.items() if value is not None}
    changes["ssim_weight"] = SSIM_WEIGHT
    folder = CellFolder(Path(out), common={"views": ViewOptions(sizes["width"]), "device": device})
    with tempfile.TemporaryDirectory() as temporary:
        if data is not None:
            names = sorted({name for group in groups for name in group})
            if download:
                download_scenes(names, Path(data))
            links = Path(os.path.realpath(temporary)) if dry_run else folder.out.absolute() / "scenes"
            paths = {name: str(link_scene(Path(data), name, links)) for name in names}
        places: dict[Path, tuple[str, Group, int]] = {}
        for group, (name, run), seed in product(groups, spec.runs.items(), seeds):
            options = _options(run).with_fit(**changes, seed=seed)
            shown = group[: run.secrets + 1]
            sources = [paths[scene] for scene in shown]
            models = [folder.plain(source, options.fit) for source in sources]
            title = f"{name}, {'-'.join(group)}" + f", seed {seed}" * (len(seeds) > 1)
            places[folder.hiding(title, sources, options, models, measures=spec.measures)] = name, shown, seed
        if dry_run:
            return folder.forecast()
        outcomes = folder.run(reporter=reporter)
    numbers: dict[str, list[dict[str, float]]] = {name: [] for name in spec.runs}
    rows = []
    for place, (name, scenes_shown, seed) in places.items():
        if (result := outcomes[place].result) is not None:
            numbers[name].append(_numbers(result.numbers))
            labels = {"run": name, "pair": "-".join(scenes_shown)}
            rows.append(outcomes[place].row(labels, scenes_shown, seed))
    covers = [] if data is None else [cover for cover, *_ in groups]
    figures = figure_rows(spec, numbers, len(groups) * len(seeds), covers)
    measured = {row.label: row.here for row in figures}
    reproduction = Reproduction(
        table=table,
        title=spec.title,
        arguments={**sizes, "seeds": list(seeds)},
        pairs=tuple("-".join(group) for group in groups),
        rows=figures,
        claims=tuple(judge_claim(claim, measured) for claim in spec.claims),
        failures={each.name: each.error for each in outcomes.values() if each.error},
    )
    write_record(folder.out / f"{table}.json", reproduction)
    write_bytes(folder.out / f"{table}.md", reproduction_text(reproduction).encode())
    write_scene_tables(
        folder.out, table, sorted(rows, key=lambda row: list(spec.runs).index(row.labels["run"]))
    )
    return reproduction


def _options(run: Run) -> MethodOptions:
    """The paper's settings with the changes of the run."""
    preset = registry.get(run.method).options.preset("full")
    design = {"design": "published"} if run.method == "keyss" else {}
    return with_changes(preset, {**design, **run.changes})


def _paths(scenes: Sequence[PathLike]) -> dict[str, str]:
    """Folders of scenes, by name. Raises UsageError."""
    if any(map(is_model, scenes)):
        raise UsageError("expected scenes, folders of photos: models have none to compare with")
    paths: dict[str, str] = {}
    for path in map(os.path.realpath, scenes):
        name = os.path.basename(path)
        if paths.setdefault(name, path) != path:
            raise UsageError(f"expected scenes of different names, got two that are called {name}")
    return paths


def groups_of(
    names: Sequence[str], secrets: int, pairs: Sequence[str], default: Sequence[Group] | None
) -> Sequence[Group]:
    """Groups of a cover and its secrets; by default each scene hides the next ones, cyclically.

    `pairs`: COVER,SECRET or COVER,SECRET,SECRET. Raises UsageError.
    """
    groups = [tuple(name.strip() for name in text.split(",")) for text in pairs]
    for text, group in zip(pairs, groups, strict=True):
        if len(group) != secrets + 1 or len(set(group)) < len(group):
            raise UsageError(
                f"`pairs`: expected a cover and {secrets} secret(s) of different names, got {text!r}"
            )
        for name in group:
            if name not in names:
                raise UsageError(f"`pairs`: no scene is called {name!r}; {did_you_mean(name, names)}")
    if groups or default:
        return groups or default or ()
    if len(names) <= secrets:
        raise UsageError(f"expected at least {secrets + 1} scenes, got {len(names)}")
    twice = [*names, *names]
    return [tuple(twice[index : index + secrets + 1]) for index in range(len(names))]


def _numbers(numbers: Mapping[str, float]) -> dict[str, float]:
    """The numbers of a cell, by the names of the paper's figures."""
    measures = ("pruning.", "rendering.", "sinkhorn.")  # prefixes of numbers named after the paper's
    figures = {name.partition(".")[2]: value for name, value in numbers.items() if name.startswith(measures)}
    secrets = [value for name, value in numbers.items() if re.fullmatch(r"secrets\.\d+\.psnr", name)]
    figures |= {f"secret {number}": psnr for number, psnr in enumerate(secrets, start=1)}
    cover, secret = numbers["cover.psnr"], fmean(secrets)
    figures |= {"cover": cover, "secret": secret, "mean of both": (cover + secret) / 2}
    # Wrong keys of the first secret's decoder.
    wrong = {"cover": "wrong_key.vs_cover.mean", "secret": "wrong_key.vs_secrets.1.mean"}
    return figures | {f"wrong key, {role}": numbers[name] for role, name in wrong.items() if name in numbers}
