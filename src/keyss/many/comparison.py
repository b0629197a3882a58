"""`compare`: methods side by side, on the same scenes and with the same budget."""

from __future__ import annotations

import io
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import fmean
from typing import TypeVar

import numpy as np
from PIL import Image

from keyss.core.arrays import Bytes
from keyss.core.errors import UsageError
from keyss.core.scene import ViewOptions
from keyss.files.atomic import write_bytes
from keyss.fitting.config import PRESETS, FitConfig
from keyss.many.cell import RUN
from keyss.many.cell_folder import CellFolder, Forecast, Outcome
from keyss.many.comparison_table import ComparedMethod, Comparison, comparison_text
from keyss.many.result_tables import write_scene_tables
from keyss.many.run_cell import keys_of
from keyss.measure.contact_sheet import contact_sheet
from keyss.measure.images import renders_of
from keyss.methods import registry
from keyss.methods.base import MethodOptions
from keyss.progress import Reporter
from keyss.rendering import Backend, resolve_device
from keyss.rendering.orbit import is_model
from keyss.runs.files import PathLike
from keyss.runs.opening import HidingRun, open_run
from keyss.runs.records import write_record

STEM = "comparison"  # of the names of its files
MEASURES = ("files", "pictures", "secrecy", "survival")
CONTROLS = (
    "control-1",
    "control-2",
)  # plain models of the cover from other seeds, as a comparison for published ones

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
    seeds: Sequence[int] = (0,),
    device: Backend = "auto",
    out: PathLike,
    dry_run: bool = False,
    reporter: Reporter | None = None,
) -> Comparison | Forecast:
    """Hide one scene in another by each of the `methods` (by default all), and tabulate the results.

    A method is a name, METHOD:PRESET or METHOD:VARIANT; all have the given steps and Gaussians, else those of
    the first one's preset. Plain models of both scenes are fitted once. Steps are counted for each scene in
    total: a method that continues the training of a plain model starts with one of half as many steps. So
    `3dgs` is the bound of all: plain 3DGS of as many Gaussians and as many training steps. With several
    `seeds` numbers are means over them.

    `out` (a folder) gets the cells, and `comparison.json`, `.md`, `.csv` and `.tex` (PSNR, SSIM and LPIPS, a
    row for each scene, with standard deviations over seeds) and `.png` (a row for each method: cover, secret,
    and the secret's error). Cells that are done are skipped. `dry_run`: only return their plans. A method
    that fails has a row with the error. Raises UsageError, before anything is trained, for one of `methods`
    that is not possible with these settings; KeyssError and its children; Interrupted.
    """
    if is_model(cover) or is_model(secret):
        raise UsageError("comparing takes scenes, folders of photos: models have none to compare with")
    chosen = {name: _named(name) for name in methods or EVERY}
    sizes = {"iterations": iterations, "max_gaussians": max_gaussians}
    given = {name: size for name, size in sizes.items() if size is not None}
    fit = replace(next(iter(chosen.values())).fit, seed=seeds[0], **given)
    scenes = [os.path.realpath(cover), os.path.realpath(secret)]
    folder = CellFolder(Path(out), common={"views": ViewOptions(width), "device": device})
    controls = [folder.plain(scenes[0], replace(fit, seed=fit.seed_of(each))) for each in CONTROLS]
    places = {
        name: [_add(folder, name, scenes, preset, replace(fit, seed=seed), controls) for seed in seeds]
        for name, preset in chosen.items()
    }
    if dry_run or methods:
        forecast = folder.forecast()
        for name in methods:
            if (reason := forecast.cells[places[name][0]].refused) is not None:
                raise UsageError(f"{name}: not possible: {reason}")
        if dry_run:
            return forecast
    outcomes = folder.run(reporter=reporter)
    arguments = {"cover": scenes[0], "secret": scenes[1], "iterations": fit.iterations}
    arguments |= {"max_gaussians": fit.max_gaussians, "width": width, "seeds": list(seeds)}
    rows = [_row(name, [outcomes[place] for place in each], folder) for name, each in places.items()]
    found = Comparison(arguments=arguments, methods=tuple(rows))
    write_record(folder.out / f"{STEM}.json", found)
    write_bytes(folder.out / f"{STEM}.md", comparison_text(found).encode())
    done = [
        (name, seed, outcomes[place])
        for name, each in places.items()
        for seed, place in zip(seeds, each, strict=True)
        if outcomes[place].result
    ]
    names = [os.path.basename(scene) for scene in scenes]
    write_scene_tables(
        folder.out, STEM, [each.row({"method": name}, names, seed) for name, seed, each in done]
    )
    runs = {name: _opened(folder, each[0]) for name, each in places.items() if outcomes[each[0]].result}
    if runs:
        picture = io.BytesIO()
        comparison_sheet(runs, device).save(picture, "PNG", optimize=True)
        write_bytes(folder.out / f"{STEM}.png", picture.getvalue())
    return found


def within(iterations: int, options: OptionsT) -> tuple[OptionsT, list[int]]:
    """Options, and steps of plain models of cover and secret: each scene has `iterations` in total."""
    continues = [each.continues and each.steps > 0 for each in options.training(2)]
    plain = iterations - iterations // 2
    own = max(1, iterations // 2) if any(continues) else iterations
    options = options.with_fit(iterations=own)
    return options, [plain if each else iterations for each in continues]


def _add(
    folder: CellFolder,
    name: str,
    scenes: Sequence[str],
    preset: MethodOptions,
    fit: FitConfig,
    controls: list[str],
) -> Path:
    """Add a hiding and its plain fits; its folder."""
    options, steps = within(fit.iterations, preset)
    options = options.with_fit(max_gaussians=fit.max_gaussians, seed=fit.seed)
    models = [
        folder.plain(scene, replace(fit, iterations=count, sh_degree=each.sh_degree))
        for scene, count, each in zip(scenes, steps, options.fits(2), strict=True)
    ]
    controls = [folder.plain(scenes[0], fit), *controls]
    return folder.hiding(name, scenes, options, models, measures=MEASURES, controls=controls)


def _named(text: str) -> MethodOptions:
    """The options of METHOD, METHOD:PRESET or METHOD:VARIANT. Raises UsageError."""
    name, _, kind = text.partition(":")
    method = registry.get(name)
    variants = method.options.variants()
    if kind and kind not in (*PRESETS, *variants):
        raise UsageError(f"{text}: expected one of {', '.join((*PRESETS, *variants))}")
    return variants[kind] if kind in variants else method.options.preset(kind or "default")


def _row(name: str, outcomes: Sequence[Outcome], folder: CellFolder) -> ComparedMethod:
    """The means of the numbers that all seeds have."""
    method = registry.get(folder.cells[outcomes[0].folder].method)
    row = ComparedMethod(name=name, keys=method.capabilities.keys)
    results = [each.result for each in outcomes if each.result is not None]
    if len(results) < len(outcomes):
        return replace(row, error=next(each.error for each in outcomes if each.error))
    shared = set.intersection(*(set(each.numbers) for each in results))
    numbers = {
        each: fmean(one.numbers[each] for one in results) for each in results[0].numbers if each in shared
    }
    return replace(row, numbers=numbers, notes=results[0].notes)


def _opened(folder: CellFolder, place: Path) -> HidingRun:
    return open_run(place / RUN, [key for key in keys_of(folder.cells[place], place) if key])


def comparison_sheet(runs: Mapping[str, HidingRun], device: Backend) -> Image.Image:
    """A row for each method: cover, secret and its error (times 4) from the middle test camera."""
    target = resolve_device(device)
    rows: dict[str, Sequence[Bytes]] = {}
    for name, run in runs.items():
        stego = run.stego.to(target)
        models = [stego, run.opened[0].reveal(stego).to(target)]
        photos, renders = [], []
        for scene, model in zip(run.scenes(train_pictures=False), models, strict=True):
            view = scene.test[len(scene.test) // 2]
            photos.append(view.image.numpy())
            renders.append(renders_of(model, scene, [view])[0][1].numpy())
        error = np.abs(photos[1].astype(int) - renders[1]).clip(0, 63).astype(np.uint8) * 4
        rows.setdefault("photos", [*photos, np.zeros_like(error)])
        rows[name] = [*renders, error]
    return contact_sheet(["cover", "secret", "error of the secret, x4"], rows)
