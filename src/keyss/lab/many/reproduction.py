"""`reproduce`: run a table of the paper on its scenes or others, and compare the figures."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from statistics import fmean
from typing import Any

from keyss.core import UsageError, ViewOptions
from keyss.core.errors import did_you_mean
from keyss.lab.many.option_changes import with_changes
from keyss.lab.many.paper import PAPER, Group, Reproduction, Run, figure_rows, judge_claim
from keyss.lab.many.result_tables import TrialNumbers, write_scene_tables
from keyss.lab.many.trial_folder import Forecast, TrialFolder
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
    full: bool = False,
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
    of 120 pixels. `full`: the scenes are the paper's, by the names of their folders; they are paired as
    published, and have 30,000 steps and 500,000 Gaussians. `pairs`: covers and secrets, as "COVER,SECRET" or
    "COVER,SECRET,SECRET" by the names of their folders; by default each scene hides the next.

    `out` (a folder) gets `TABLE.json`, `.csv` and `.tex` (PSNR, SSIM and LPIPS per scene, with
    standard deviations over `seeds`), and the trials, which tables in one folder share. Finished trials are
    skipped. `dry_run`: only return their plans. The result lists failed trials. Raises KeyssError for
    impossible scenes and arguments; KeyboardInterrupt.
    """
    if table not in PAPER.tables:
        raise UsageError(f"no table is called {table!r}; {did_you_mean(table, PAPER.tables)}")
    if width is not None and width < 1:
        raise UsageError(f"`width`: expected at least 1, got {width}")
    spec, paths = PAPER.tables[table], _paths(scenes)
    groups = groups_of(list(paths), spec.secrets, pairs, spec.groups if full else ())
    given = {"iterations": iterations, "max_gaussians": max_gaussians, "width": width}
    sizes = {name: SMALL[name] if value is None and not full else value for name, value in given.items()}
    changes: dict[str, Any] = {"ssim_weight": SSIM_WEIGHT}
    changes |= {name: sizes[name] for name in ("iterations", "max_gaussians") if sizes[name] is not None}
    folder = TrialFolder(Path(out), common={"views": ViewOptions(sizes["width"]), "device": device})
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
    for place, (name, shown, seed) in places.items():
        if (result := outcomes[place].result) is not None:
            numbers[name].append(_numbers(result.numbers))
            labels = {"run": name, "pair": "-".join(shown)}
            rows.append(TrialNumbers.of(outcomes[place], labels, shown, seed))
    covers = [cover for cover, *_ in groups] if full else []
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
    order = list(spec.runs)
    write_scene_tables(folder.out, table, sorted(rows, key=lambda row: order.index(row.labels["run"])))
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
    names: Sequence[str], secrets: int, pairs: Sequence[str], published: Sequence[Group]
) -> Sequence[Group]:
    """Groups of a cover and its secrets: those of `pairs`, the `published` ones, or each scene and the next.

    `pairs`: COVER,SECRET or COVER,SECRET,SECRET. Raises UsageError.
    """
    groups = [tuple(name.strip() for name in text.split(",")) for text in pairs]
    for text, group in zip(pairs, groups, strict=True):
        if len(group) != secrets + 1 or len(set(group)) < len(group):
            raise UsageError(
                f"`pairs`: expected a cover and {secrets} secret(s) of different names, got {text!r}"
            )
    groups = groups or list(published)
    for name in (name for group in groups for name in group):
        if name not in names:
            raise UsageError(f"expected a scene called {name!r}, got {', '.join(names) or 'none'}")
    if groups:
        return groups
    if len(names) <= secrets:
        raise UsageError(f"expected at least {secrets + 1} scenes, got {len(names)}")
    twice = [*names, *names]
    return [tuple(twice[index : index + secrets + 1]) for index in range(len(names))]


def _numbers(numbers: Mapping[str, float]) -> dict[str, float]:
    """The numbers of a trial, by the names of the paper's figures."""
    measures = ("pruning.", "rendering.", "sinkhorn.")  # prefixes of numbers named after the paper's
    figures = {name.partition(".")[2]: value for name, value in numbers.items() if name.startswith(measures)}
    secrets = [value for name, value in numbers.items() if re.fullmatch(r"secrets\.\d+\.psnr", name)]
    figures |= {f"secret {number}": psnr for number, psnr in enumerate(secrets, start=1)}
    cover, secret = numbers["cover.psnr"], fmean(secrets)
    figures |= {"cover": cover, "secret": secret, "mean of both": (cover + secret) / 2}
    # Wrong keys of the first secret's decoder.
    wrong = {"cover": "wrong_key.vs_cover.mean", "secret": "wrong_key.vs_secrets.1.mean"}
    return figures | {f"wrong key, {role}": numbers[name] for role, name in wrong.items() if name in numbers}
