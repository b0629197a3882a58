"""`compare`: methods side by side, on the same scenes and with the same budget."""

from __future__ import annotations

import io
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from keyss.core.errors import UsageError
from keyss.core.scene import ViewOptions
from keyss.files.atomic import write_bytes
from keyss.fitting.config import PRESETS, FitConfig
from keyss.many.comparison import ComparedMethod, Comparison, comparison_text
from keyss.many.folder import CellFolder, Forecast
from keyss.many.performing import keys_of
from keyss.many.running import Outcome
from keyss.many.sheet import comparison_sheet
from keyss.methods import registry
from keyss.methods.base import MethodOptions
from keyss.progress import Reporter, reporter as default_reporter
from keyss.rendering import Backend
from keyss.rendering.orbit import is_model
from keyss.runs.opening import HidingRun, open_run
from keyss.runs.records import write_record
from keyss.runs.sources import PathLike

RECORD, TABLE, PICTURE = "comparison.json", "comparison.md", "comparison.png"
MEASURES = ("files", "pictures", "secrecy", "survival")
CONTROLS = 2  # plain models of the cover from other seeds, as a comparison for published ones

# Every method, and its variants.
EVERY = tuple(
    name
    for each in registry.METHODS
    for name in (each, *(f"{each}:{variant}" for variant in registry.get(each).options.variants()))
)

OptionsT = TypeVar("OptionsT", bound=MethodOptions)


def compare(
    cover: PathLike,
    secret: PathLike,
    *,
    methods: Sequence[str] = (),
    iterations: int | None = None,
    max_gaussians: int | None = None,
    width: int | None = None,
    seed: int = 0,
    device: Backend = "auto",
    out: PathLike,
    dry_run: bool = False,
    reporter: Reporter | None = None,
) -> Comparison | Forecast:
    """Hide one scene in another by each of the `methods` (by default all), and tabulate the results.

    A method is a name, METHOD:PRESET or METHOD:VARIANT; all have the given steps and Gaussians, else those of
    the first one's preset. Plain models of both scenes are fitted once. Steps are counted for each scene in
    total: a method that continues the training of a plain model starts with one of half as many steps. So
    `3dgs` is the bound of all: plain 3DGS of as many Gaussians and as many training steps.

    `out` (a folder) gets the cells, and `comparison.json`, `.md` and `.png` (a row for each method: cover,
    secret, and the secret's error). Cells that are done are skipped. `dry_run`: only return their plans.
    A method that fails has a row with the error. Raises UsageError, before anything is trained, for one of
    `methods` that is not possible with these settings; KeyssError and its children; Interrupted.
    """
    if is_model(cover) or is_model(secret):
        raise UsageError("comparing takes scenes, folders of photos: models have none to compare with")
    chosen = {name: _named(name) for name in methods or EVERY}
    sizes = {"iterations": iterations, "max_gaussians": max_gaussians}
    asked = {name: size for name, size in sizes.items() if size is not None}
    fit = replace(next(iter(chosen.values())).fit, seed=seed, **asked)
    scenes = [os.path.realpath(cover), os.path.realpath(secret)]
    folder = CellFolder(Path(out), common={"views": ViewOptions(width), "device": device})
    places = _places(folder, scenes, chosen, fit)
    if dry_run or methods:
        forecast = folder.forecast()
        refused = {each.id: each.refused for each in forecast.cells}
        for name in methods:
            if (reason := refused[places[name].name]) is not None:
                raise UsageError(f"{name}: not possible: {reason}")
        if dry_run:
            return forecast
    outcomes = folder.run(f"comparison of {len(places)} methods", reporter=reporter or default_reporter())
    told = {"cover": scenes[0], "secret": scenes[1], "iterations": fit.iterations}
    told |= {"max_gaussians": fit.max_gaussians, "width": width, "seed": seed}
    rows = [_row(name, outcomes[place], folder) for name, place in places.items()]
    found = Comparison(arguments=told, methods=tuple(rows))
    write_record(folder.out / RECORD, found)
    write_bytes(folder.out / TABLE, comparison_text(found).encode())
    runs = {name: _opened(folder, place) for name, place in places.items() if outcomes[place].result}
    if runs:
        picture = io.BytesIO()
        comparison_sheet(runs, device).save(picture, "PNG", optimize=True)
        write_bytes(folder.out / PICTURE, picture.getvalue())
    return found


def within(iterations: int, options: OptionsT) -> tuple[OptionsT, list[int]]:
    """Options, and steps of plain models of cover and secret: each scene has `iterations` in total."""
    continues = [each.continues and each.steps > 0 for each in options.training(2)]
    plain = iterations - iterations // 2
    own = max(1, iterations // 2) if any(continues) else iterations
    options = options.with_fit(iterations=own)
    return options, [plain if each else iterations for each in continues]


def _places(
    folder: CellFolder, scenes: Sequence[str], chosen: dict[str, MethodOptions], fit: FitConfig
) -> dict[str, Path]:
    """Add all cells; the folder of each method's."""
    seeds = [fit.known_seed, *(fit.seed_of(f"control-{number}") for number in range(1, CONTROLS + 1))]
    controls = [folder.plain(scenes[0], replace(fit, seed=seed)) for seed in seeds]
    found = {}
    for name, preset in chosen.items():
        options, steps = within(fit.iterations, preset)
        options = options.with_fit(max_gaussians=fit.max_gaussians, seed=fit.seed)
        degrees = [each.sh_degree for each in options.fits(2)]
        plain = [
            replace(fit, iterations=count, sh_degree=degree)
            for count, degree in zip(steps, degrees, strict=True)
        ]
        models = [folder.plain(*each) for each in zip(scenes, plain, strict=True)]
        found[name] = folder.hiding(name, scenes, options, models, measures=MEASURES, controls=controls)
    return found


def _named(text: str) -> MethodOptions:
    """The options of METHOD, METHOD:PRESET or METHOD:VARIANT. Raises UsageError."""
    name, _, kind = text.partition(":")
    method = registry.get(name)
    variants = method.options.variants()
    if kind and kind not in (*PRESETS, *variants):
        raise UsageError(f"{text}: expected one of {', '.join((*PRESETS, *variants))}")
    return variants[kind] if kind in variants else method.options.preset(kind or "default")


def _row(name: str, outcome: Outcome, folder: CellFolder) -> ComparedMethod:
    method = registry.get(folder.cells[outcome.folder].method)
    row = ComparedMethod(name=name, keys=method.capabilities.keys, max_secrets=method.most_secrets)
    if outcome.result is None:
        return replace(row, error=outcome.error)
    run = outcome.folder / folder.cells[outcome.folder].run
    place = str(run.relative_to(folder.out))
    return replace(row, run=place, numbers=outcome.result.numbers, notes=outcome.result.notes)


def _opened(folder: CellFolder, place: Path) -> HidingRun:
    cell = folder.cells[place]
    return open_run(place / cell.run, [key for key in keys_of(cell) if key])
