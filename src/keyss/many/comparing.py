"""`compare`: methods side by side, on the same scenes and with the same budget, in two tables."""

from __future__ import annotations

import io
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from keyss._version import __version__
from keyss.core.arrays import Bytes
from keyss.core.errors import UsageError
from keyss.core.scene import ViewOptions
from keyss.files.atomic import write_bytes
from keyss.fitting.config import PRESETS, FitConfig
from keyss.many.measures import CONVERSIONS
from keyss.many.performing import keys_of
from keyss.many.running import CellFolder, Forecast, Outcome
from keyss.many.tables import markdown_rows
from keyss.measure.images import renders_of
from keyss.methods import registry
from keyss.methods.base import MethodOptions
from keyss.progress import Reporter, reporter as default_reporter
from keyss.rendering import Backend, resolve_device
from keyss.rendering.orbit import is_model
from keyss.runs.files import PathLike
from keyss.runs.opening import HidingRun, open_run
from keyss.runs.records import write_record

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
_LEGEND = (
    "Test views: photos that were not trained on. Steps: those in which cover and secret were rendered, in "
    "total. 3dgs is the bound: plain 3DGS of as many Gaussians and as many training steps. Picture: the time "
    "of one of the cover and of the secret, and its ratio to that of plain 3DGS. Seconds: of hiding, after "
    "plain models.",
    "Wrong keys: PSNR in dB of what they show against the cover, and at most against the secret; in brackets "
    "that of the published model itself against the secret. Classifier and StegExpose: area under the ROC "
    "curve against plain models of the cover from other seeds, 0.5 where they cannot be told apart. p: of "
    "the file's least likely statistic beside those. In brackets the same of a plain model of the cover.",
    "Pruned of a random quarter, converted and back, purified (as by GSPure): change of cover and secret in "
    "dB. Lost: the secret no longer opens.",
)
Picture = Bytes  # [H, W, 3]


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
    given = {name: size for name, size in sizes.items() if size is not None}
    fit = replace(next(iter(chosen.values())).fit, seed=seed, **given)
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
    arguments = {"cover": scenes[0], "secret": scenes[1], "iterations": fit.iterations}
    arguments |= {"max_gaussians": fit.max_gaussians, "width": width, "seed": seed}
    rows = [_row(name, outcomes[place], folder) for name, place in places.items()]
    found = Comparison(arguments=arguments, methods=tuple(rows))
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
    row = ComparedMethod(name=name, keys=method.capabilities.keys, max_secrets=method.max_secrets)
    if outcome.result is None:
        return replace(row, error=outcome.error)
    run = outcome.folder / folder.cells[outcome.folder].run
    place = str(run.relative_to(folder.out))
    return replace(row, run=place, numbers=outcome.result.numbers, notes=outcome.result.notes)


def _opened(folder: CellFolder, place: Path) -> HidingRun:
    cell = folder.cells[place]
    return open_run(place / cell.run, [key for key in keys_of(cell) if key])


@dataclass(frozen=True, kw_only=True)
class ComparedMethod:
    """One method; `error` is the reason for a missing result."""

    name: str  # METHOD, METHOD:PRESET or METHOD:VARIANT
    run: str | None = None  # the folder of its run, relative to that of the comparison
    error: str | None = None
    keys: bool = True
    max_secrets: int = 1
    numbers: dict[str, float] = field(default_factory=dict)  # see `keyss.many.cell.Result`
    notes: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """`comparison.json`."""

    version: int = 3
    keyss: str = __version__
    arguments: dict[str, Any]
    methods: tuple[ComparedMethod, ...] = ()


Column = Callable[[ComparedMethod], str]


def comparison_tables(found: Comparison) -> dict[str, list[list[str]]]:
    """Rows of text by title, the heads first: fidelity and cost, secrecy and survival.

    Methods that failed have no row.
    """
    rows = [each for each in found.methods if each.error is None]
    return {
        title: [
            [head.rstrip() for head in columns],
            *([shown(row) for shown in columns.values()] for row in rows),
        ]
        for title, columns in (("Fidelity and cost", _FIDELITY), ("Secrecy and survival", _SECRECY))
    }


def comparison_notes(comparison: Comparison) -> list[str]:
    """A sentence for each method that failed, and for each reason to skip a measure; the legend."""
    failures = [f"{row.name}: not possible: {row.error}" for row in comparison.methods if row.error]
    reasons: dict[str, list[str]] = {}
    for row in comparison.methods:
        for measure, reason in row.notes.items():
            reasons.setdefault(f"{measure.partition('.')[2]}: {reason}", []).append(row.name)
    skipped = [f"not tried ({', '.join(names)}): {reason}" for reason, names in reasons.items()]
    return [*failures, *skipped, *_LEGEND]


def comparison_text(comparison: Comparison) -> str:
    """Both tables and the notes in Markdown."""
    lines = []
    for title, rows in comparison_tables(comparison).items():
        lines += [f"## {title}", "", *markdown_rows(rows), ""]
    lines += [f"- {note}" for note in comparison_notes(comparison)]
    return "\n".join(lines) + "\n"


def _number(name: str, form: str) -> Column:
    """The number of this name, formatted; nothing where it was not measured."""
    return lambda each: f"{each.numbers[name]:{form}}" if name in each.numbers else ""


def _bytes(name: str) -> Column:
    return lambda each: f"{each.numbers[name] / 1e6:,.2f} MB" if each.numbers[name] else "nothing"


def _picture(each: ComparedMethod) -> str:
    names = [f"pictures.{role}" for role in _ROLES]
    times = [(1e3 * each.numbers[f"{name}.seconds"], each.numbers[f"{name}.ratio"]) for name in names]
    return ", ".join(f"{milliseconds:.0f} ({ratio:.1f}x)" for milliseconds, ratio in times)


def _steps(each: ComparedMethod) -> str:
    found = [each.numbers.get(f"steps.{index}") for index in (1, 2)]
    return ", ".join("unknown" if steps is None else f"{steps:,.0f}" for steps in found)


def _wrong_keys(each: ComparedMethod) -> str:
    names = ("wrong_key.vs_cover.mean", "wrong_key.vs_secrets.1.max", "chance_level.1")
    shown = [each.numbers[name] for name in names if name in each.numbers]
    if len(shown) == len(names):
        return "{:.1f}, {:.1f} ({:.1f})".format(*shown)
    return "open nothing" if each.keys else "no keys"


def _standard(each: ComparedMethod) -> str:
    """Measured with third-party readers, not the method's claim."""
    tried, load = (int(each.numbers[f"files.{name}"]) for name in ("readers", "readers that load"))
    word = "yes" if load == tried else "no"
    return f"{word}, {load} of {tried} readers" if tried else "not tried"


def _beside(name: str, shown: Callable[[float], str]) -> Column:
    """A number of the published model, and in brackets the same for a plain one."""

    def column(each: ComparedMethod) -> str:
        own, plain = (each.numbers.get(f"secrecy.{name}{end}") for end in ("", "_plain"))
        if own is None:
            return "no 3DGS"
        return shown(own) if plain is None else f"{shown(own)} ({shown(plain)})"

    return column


def _area(value: float) -> str:
    return f"{value:.2f}"


def _probability(value: float) -> str:
    return "<1e-16" if value < 1e-16 else f"{value:.1g}"


def _survived(change: str) -> Column:
    def column(each: ComparedMethod) -> str:
        cover, secret = (each.numbers.get(f"survival.{change}.{role}") for role in _ROLES)
        if cover is None:
            return "not tried"
        return f"{_gained(cover)}, {'lost' if secret is None else _gained(secret)}"

    return column


def _gained(loss: float) -> str:
    """The gain in decibels, without -0.0."""
    return f"{0.0 - round(loss, 1):+.1f}"


_ROLES = ("cover", "secret")
_FIDELITY: dict[str, Column] = {
    "method": lambda each: each.name,
    "cover": _number("cover.psnr", ".2f"),
    "SSIM": _number("cover.ssim", ".3f"),
    "secret": _number("secrets.1.psnr", ".2f"),
    "SSIM ": _number("secrets.1.ssim", ".3f"),
    "published": _bytes("files.published"),
    "handed over": _bytes("files.handed"),
    "picture, ms": _picture,
    "seconds": _number("seconds", ".0f"),
    "steps": _steps,
}
_SECRECY: dict[str, Column] = {
    "method": lambda each: each.name,
    "keys": lambda each: "yes" if each.keys else "no",
    "secrets": lambda each: f"{each.max_secrets}",
    "wrong keys": _wrong_keys,
    "standard .ply": _standard,
    "classifier": _beside("classifier", _area),
    "p": _beside("stealth", _probability),
    "StegExpose": _beside("stegexpose", _area),
    **{name: _survived(name) for name in ("pruned", *(each[0] for each in CONVERSIONS), "purified")},
}


def comparison_sheet(runs: Mapping[str, HidingRun], device: Backend) -> Image.Image:
    """A row for each method: cover, secret and its error (times 4) from the middle test camera."""
    target = resolve_device(device)
    rows: dict[str, Sequence[Picture]] = {}
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


def contact_sheet(
    heads: Sequence[str], rows: Mapping[str, Sequence[Picture]], cell: int = 200
) -> Image.Image:
    """Rows of pictures, each `cell` pixels high, beside the names of the rows and below heads."""
    gap, font = cell // 40, ImageFont.load_default(cell // 14)
    scaled = [
        [
            Image.fromarray(each).resize((max(1, round(each.shape[1] * cell / each.shape[0])), cell))
            for each in pictures
        ]
        for pictures in rows.values()
    ]
    label = max(math.ceil(font.getlength(name)) for name in rows) + gap
    lines = 1 + max(head.count("\n") for head in heads)
    top = gap + lines * (cell // 8)
    widths = [
        max(
            *(math.ceil(font.getlength(line)) for line in ["", *head.split("\n")]),
            *(each.width for each in column),
        )
        for head, column in zip(heads, zip(*scaled, strict=True), strict=True)
    ]
    starts = [label + gap + sum(widths[:index]) + gap * index for index in range(len(widths))]
    size = starts[-1] + widths[-1] + gap, top + (cell + gap) * len(rows)
    sheet = Image.new("RGB", size, "white")
    draw = ImageDraw.Draw(sheet)
    for x, head in zip(starts, heads, strict=True):
        draw.multiline_text((x, gap), head, fill=(20, 20, 20), font=font)
    for number, (name, pictures) in enumerate(zip(rows, scaled, strict=True)):
        y = top + (cell + gap) * number
        draw.text((gap, y + gap), name, fill=(20, 20, 20), font=font)
        for x, picture in zip(starts, pictures, strict=True):
            sheet.paste(picture, (x, y))
    return sheet
