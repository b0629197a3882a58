"""`compare`: methods on the same scenes with the same budget, and tables of the results."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np

from keyss._version import __version__
from keyss.core import UsageError, ViewOptions
from keyss.core.arrays import Bytes
from keyss.files import write_bytes
from keyss.fitting import PRESETS, FitConfig
from keyss.fitting.image_metrics import HOW_TO_GET
from keyss.lab.audits.trial_measures import CONVERSIONS
from keyss.lab.many.result_tables import write_scene_tables
from keyss.lab.many.trial import opened_run
from keyss.lab.many.trial_folder import Forecast, Outcome, TrialFolder
from keyss.measure.renders import contact_sheet, renders_of
from keyss.methods import MethodOptions, registry
from keyss.progress import Reporter
from keyss.rendering import Backend, resolve_device
from keyss.runs import write_record
from keyss.runs.files import PathLike
from keyss.runs.open_run import HidingRun

STEM = "comparison"  # file names without their suffix
MEASURES = ("files", "pictures", "secrecy", "survival")
CONTROLS = ("control-1", "control-2")  # plain models of the cover; the names of their seeds

# Every method, and its variants.
EVERY = tuple(
    name
    for method in registry.METHODS
    for name in (method, *(f"{method}:{variant}" for variant in registry.get(method).options.variants()))
)

# %-formats by column. The first one whose numbers were all measured is used.
_FIDELITY = {
    "cover": ["%(cover.psnr).2f"],
    "SSIM": ["%(cover.ssim).3f"],
    "LPIPS": ["%(cover.lpips).3f"],
    "secret": ["%(secrets.1.psnr).2f"],
    "SSIM ": ["%(secrets.1.ssim).3f"],
    "LPIPS ": ["%(secrets.1.lpips).3f"],
    "published, MB": ["%(files.published_mb).2f"],
    "companion files, MB": ["%(files.companion_mb).2f"],
    "cover, pictures/s": ["%(pictures.pictures/s, cover).0f (%(pictures.time over 3DGS, cover).1f)"],
    "secret, pictures/s": ["%(pictures.pictures/s, secret).0f (%(pictures.time over 3DGS, secret).1f)"],
    "seconds": ["%(seconds).0f"],
    "steps": ["%(steps.1)d, %(steps.2)d", "unknown"],
}
_SECRECY = {
    "wrong keys": [
        "%(wrong_key.vs_cover.mean).1f, %(wrong_key.vs_secrets.1.max).1f (%(chance_level.1).1f)",
        "%(wrong keys)s",
    ],
    "classifier": ["%(secrecy.classifier).2f", "no 3DGS"],
    "p": ["%(secrecy.stealth).1g", "no 3DGS"],
    "StegExpose": ["%(secrecy.stegexpose).2f"],
    **{
        head: [
            f"%(survival.{head}, cover)+.1f, %(survival.{head}, secret)+.1f",
            f"%(survival.{head}, cover)+.1f, lost",
            "not tried",
        ]
        for head in ("pruned", *CONVERSIONS, "purified")
    },
}
_LEGEND = (
    "Test views: photos that were not trained on. Steps: those in which cover and secret were rendered, in "
    "total. 3dgs is the upper bound: plain 3DGS with equal numbers of Gaussians and training steps; "
    "3dgs:half has half as many Gaussians for each scene, like a model that both share. "
    "Pictures/s: in brackets, the time over that of plain 3DGS. Seconds: time of hiding, after plain models.",
    "Wrong keys: mean PSNR in dB of their renders against the cover, and maximum against the secret; in "
    "brackets, the published model itself against the secret. Classifier and StegExpose: area under the ROC "
    "curve against plain models of the cover with other seeds; 0.5 if indistinguishable. p: minimum p-value "
    "of the file's statistics against those models. The file of 3dgs is a plain model of the cover.",
    "Pruned (a random quarter), converted and back, purified (GSPure): change of cover and secret in dB. "
    "Lost: the secret no longer opens.",
)


@dataclass(frozen=True, kw_only=True)
class ComparedMethod:
    """One method; `error` is the reason for a missing result."""

    name: str  # METHOD, METHOD:PRESET or METHOD:VARIANT
    error: str | None = None
    keys: bool = True  # whether a key opens the secret
    numbers: dict[str, float] = field(default_factory=dict)  # see `Result` of trial.py; means over seeds
    notes: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """`comparison.json`."""

    version: int = 5
    keyss: str = __version__
    arguments: dict[str, Any]
    methods: tuple[ComparedMethod, ...] = ()


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

    A method is a name, METHOD:PRESET or METHOD:VARIANT; all have the given steps and Gaussians, or those of
    the first one's preset. Plain models of both scenes are fitted once. Steps are totals per scene: a method
    that continues the training of a plain model starts with one of half the steps. Thus `3dgs` is an upper
    bound for all: plain 3DGS with equal Gaussians and training steps. Numbers are means over `seeds`.

    `out` (a folder) gets the trials, and `comparison.json`, `.csv` and `.tex` (PSNR, SSIM and LPIPS per
    scene, with standard deviations over seeds) and `.png` (a row per method: cover, secret, and the
    secret's error). Finished trials are skipped. `dry_run`: only return their costs. A failed method has a
    row with the error. Raises UsageError before training if one of `methods` is not possible with these
    settings, other KeyssErrors, and KeyboardInterrupt.
    """
    kind = resolve_device(device).type
    chosen = {name: _parse_method(name, kind) for name in methods or EVERY}
    sizes = {"iterations": iterations, "max_gaussians": max_gaussians}
    given = {name: size for name, size in sizes.items() if size is not None}
    fit = replace(next(iter(chosen.values())).fit, seed=seeds[0], **given)
    scenes = [os.path.realpath(cover), os.path.realpath(secret)]
    folder = TrialFolder(Path(out), common={"views": ViewOptions(width), "device": device})
    controls = [folder.plain(scenes[0], replace(fit, seed=fit.seed_of(name)), name) for name in CONTROLS]
    shown = {seed: f"seed {seed}" * (len(seeds) > 1) for seed in seeds}
    places = {
        (name, seed): _add(folder, name, scenes, preset, replace(fit, seed=seed), controls, shown[seed])
        for name, preset in chosen.items()
        for seed in seeds
    }
    if dry_run or methods:
        forecast = folder.forecast(reporter)
        for name in methods:
            if reason := forecast.refused.get(places[name, seeds[0]]):
                raise UsageError(f"{name}: not possible: {reason}")
        if dry_run:
            return forecast
    outcomes = folder.run(reporter=reporter)
    arguments = {"cover": scenes[0], "secret": scenes[1], "iterations": fit.iterations}
    arguments |= {"max_gaussians": fit.max_gaussians, "width": width, "seeds": list(seeds)}
    rows = [_row(name, [outcomes[places[name, seed]] for seed in seeds]) for name in chosen]
    comparison = Comparison(arguments=arguments, methods=tuple(rows))
    write_record(folder.out / f"{STEM}.json", comparison)
    write_scene_tables(folder.out, STEM, outcomes.values())
    first = {name: outcomes[places[name, seeds[0]]] for name in chosen}
    runs = {name: opened_run(each.trial, each.folder) for name, each in first.items() if each.result}
    if runs:
        write_bytes(folder.out / f"{STEM}.png", comparison_sheet(runs, device))
    return comparison


def _add(
    folder: TrialFolder,
    name: str,
    scenes: Sequence[str],
    preset: MethodOptions,
    fit: FitConfig,  # with the total steps per scene
    controls: list[str],
    note: str,
) -> Path:
    """Add a hiding and its plain fits; returns the folder of the hiding. `note`: see `TrialFolder.plain`."""
    half = fit.iterations // 2
    continues = [training.continues and training.steps > 0 for training in preset.training(2)]
    options = preset.with_fit(
        iterations=max(1, half) if any(continues) else fit.iterations,
        max_gaussians=fit.max_gaussians,
        seed=fit.seed,
    )
    steps = [fit.iterations - half if continued else fit.iterations for continued in continues]
    models = [
        folder.plain(
            scene,
            replace(fit, iterations=count, sh_degree=config.sh_degree, max_gaussians=config.max_gaussians),
            note,
        )
        for scene, count, config in zip(scenes, steps, options.fits(2), strict=True)
    ]
    labels = {"method": name}
    return folder.hiding(name, scenes, options, models, labels=labels, measures=MEASURES, controls=controls)


def _parse_method(text: str, device: str) -> MethodOptions:
    """The options of METHOD, METHOD:PRESET or METHOD:VARIANT. Raises UsageError."""
    name, _, kind = text.partition(":")
    method = registry.get(name)
    variants = method.options.variants()
    if kind and kind not in (*PRESETS, *variants):
        raise UsageError(f"{text}: expected one of {', '.join((*PRESETS, *variants))}")
    return variants[kind] if kind in variants else method.options.preset(kind or "default", device)


def _row(name: str, outcomes: Sequence[Outcome]) -> ComparedMethod:
    """The means of the numbers that all seeds have."""
    keys = registry.get(outcomes[0].trial.method).capabilities.keys
    row = ComparedMethod(name=name, keys=keys)
    results = [outcome.result for outcome in outcomes if outcome.result is not None]
    if len(results) < len(outcomes):
        return replace(row, error=next(outcome.error for outcome in outcomes if outcome.error))
    shared = set.intersection(*(set(result.numbers) for result in results))
    numbers = {
        measure: fmean(one.numbers[measure] for one in results)
        for measure in results[0].numbers
        if measure in shared
    }
    return replace(row, numbers=numbers, notes=results[0].notes)


def comparison_sheet(runs: Mapping[str, HidingRun], device: Backend) -> bytes:
    """A PNG file with a row per method: cover, secret and its error (times 4) from the middle test camera."""
    target = resolve_device(device)
    rows: dict[str, Sequence[Bytes]] = {}
    for name, run in runs.items():
        stego = run.stego.to(target)
        models = [stego, run.opened[0].reveal(stego).to(target)]
        photos, renders = [], []
        for scene, model in zip(run.scenes(train_pictures=False), models, strict=True):
            view = scene.test[len(scene.test) // 2]
            photos.append(view.image.numpy())
            renders.append(renders_of(model, [view.camera], scene.background)[0][1].numpy())
        error = np.abs(photos[1].astype(int) - renders[1]).clip(0, 63).astype(np.uint8) * 4
        rows.setdefault("photos", [*photos, np.zeros_like(error)])
        rows[name] = [*renders, error]
    return contact_sheet(["cover", "secret", "error of the secret, x4"], rows)


def comparison_tables(comparison: Comparison) -> list[list[list[str]]]:
    """Two tables of text, heads first: fidelity and cost, secrecy and survival; without failed methods."""
    rows = [row for row in comparison.methods if row.error is None]
    return [
        [
            ["method", *(head.rstrip() for head in columns)],
            *([row.name, *(_format(row, formats) for formats in columns.values())] for row in rows),
        ]
        for columns in (_FIDELITY, _SECRECY)
    ]


def _format(row: ComparedMethod, formats: list[str]) -> str:
    values = row.numbers | {"wrong keys": "open nothing" if row.keys else "no keys"}
    for template in formats:
        with suppress(KeyError):
            return template % values
    return ""


def comparison_notes(comparison: Comparison) -> list[str]:
    """Lines on failed methods and on skipped measures, and the legend."""
    failures = [f"{row.name}: not possible: {row.error}" for row in comparison.methods if row.error]
    reasons: dict[str, list[str]] = {}
    for row in comparison.methods:
        for measure, reason in row.notes.items():
            what = measure.partition(".")[2]
            reasons.setdefault(f"not tried: {what}: {reason}", []).append(row.name)
    skipped = [f"{reason} ({', '.join(names)})" for reason, names in reasons.items()]
    if any("cover.lpips" not in row.numbers for row in comparison.methods if row.numbers):
        skipped.append(f"no LPIPS: {HOW_TO_GET}")
    return [*failures, *skipped, *_LEGEND]
