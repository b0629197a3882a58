"""`compare`: methods beside each other, on the same scenes and with the same budget."""

from __future__ import annotations

import io
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from keyss._verbs.asking import Secret
from keyss._verbs.fitting import fit
from keyss._verbs.hiding import hide
from keyss.core.errors import KeyssError, OutputError, UsageError
from keyss.files.atomic import write_bytes
from keyss.files.images import picture_name
from keyss.files.reading import read_text
from keyss.fitting.config import FitConfig
from keyss.fitting.loop import Reporter
from keyss.keys import generate_key
from keyss.measure.images import compare_images, renders_of
from keyss.measure.robustness.changes import random_pruning
from keyss.measure.robustness.survival import ChangedQuality
from keyss.measure.robustness.survival import robustness as after_changes
from keyss.measure.speed import render_time
from keyss.methods import registry
from keyss.methods.base import Method, MethodOptions
from keyss.rendering import Backend, resolve_device
from keyss.rendering.orbit import is_model
from keyss.runs.comparison import ComparedMethod, Comparison, SceneScores, markdown
from keyss.runs.config import PathLike
from keyss.runs.files import HANDED, MODEL, is_run, stego_in
from keyss.runs.folder import read_manifest
from keyss.runs.opening import HidingRun, open_run
from keyss.runs.records import read_record, write_record

RECORD, TABLE, PICTURE, KEY = "comparison.json", "comparison.md", "comparison.png", "key.txt"
_BEGUN = "arguments.json"
_LOST = 0.25  # of the Gaussians
_ROUNDS = 5  # of timing pictures


@dataclass(frozen=True, kw_only=True)
class _Begun:
    """What a comparison was told."""

    version: int = 1
    told: dict[str, Any]
    seed: int


def compare(
    cover: PathLike,
    secret: PathLike,
    *,
    methods: Sequence[str] = (),
    iterations: int | None = None,
    max_gaussians: int | None = None,
    width: int | None = None,
    seed: int | None = None,
    device: Backend = "auto",
    out: PathLike,
    resume: bool = False,
    reporter: Reporter | None = None,
) -> Comparison:
    """Hide one scene in another by each of the `methods` (all by default), and lay out what they come to.

    A method is a name, or METHOD:PRESET. Plain models of both scenes are fitted once, by the steps, Gaussians
    and seed that all methods get. `out` gets them, the folder of a run for each method, a key for those that
    have keys, and `comparison.json`, `.md` and `.png` (a row for each method: cover, secret, and the secret's
    error). What was finished is not done again with `resume`. What a method cannot do is its row.
    Raises KeyssError for scenes that cannot be read and for folders that hold something else; Interrupted.
    """
    if is_model(cover) or is_model(secret):
        raise UsageError("comparing takes scenes, folders of photos: models have none to compare with")
    chosen = [_named(name) for name in methods or registry.METHODS]
    folder, budget = Path(out), {"iterations": iterations, "max_gaussians": max_gaussians}
    told: dict[str, Any] = {"cover": os.path.realpath(cover), "secret": os.path.realpath(secret)}
    told |= {**budget, "width": width}
    seed = _begin(folder, told, seed, resume)
    key = read_text(folder / KEY).strip()
    changes = {name: value for name, value in {**budget, "seed": seed}.items() if value is not None}
    plain = [
        _plain(folder / name, scene, replace(chosen[0][2].fit, **changes), width, device, reporter)
        for name, scene in (("plain-cover", cover), ("plain-secret", secret))
    ]
    rows = []
    for name, method, options in chosen:
        place = folder / name.replace(":", "-")
        if (done := folder / f"{place.name}.json").exists():
            rows.append(read_record(done, ComparedMethod))
            continue
        own = key if method.capabilities.keys else ""
        try:
            if not is_run(place):
                hide(
                    cover,
                    [Secret(secret, own, plain[1])],
                    method=options.with_fit(**changes),
                    width=width,
                    cover_model=plain[0],
                    min_psnr=0,  # however bad it is
                    device=device,
                    out=place,
                    resume=read_manifest(place).running is not None,
                    reporter=reporter,
                )
            rows.append(_measured(name, method, open_run(place, [own] if own else []), device))
            write_record(done, rows[-1])
        except KeyssError as error:
            rows.append(ComparedMethod(name=name, error=str(error), capabilities=method.capabilities))
    found = Comparison(arguments=told | {"seed": seed}, methods=tuple(rows))
    write_record(folder / RECORD, found)
    write_bytes(folder / TABLE, markdown(found).encode())
    picture = io.BytesIO()
    _sheet(_runs(folder, found), device).save(picture, "PNG", optimize=True)
    write_bytes(folder / PICTURE, picture.getvalue())
    return found


def _named(text: str) -> tuple[str, Method, MethodOptions]:
    """Name, method and options of METHOD or METHOD:PRESET. Raises UsageError."""
    name, _, preset = text.partition(":")
    method = registry.get(name)
    if preset and preset not in method.presets:
        raise UsageError(f"{text}: expected one of the presets {', '.join(method.presets)}")
    return text, method, method.presets[preset or next(iter(method.presets))]


def _begin(folder: Path, told: dict[str, Any], seed: int | None, resume: bool) -> int:
    """The seed of the comparison that is in `folder` from now on. Raises OutputError."""
    begun = folder / _BEGUN
    if folder.exists() and any(folder.iterdir()):
        if not begun.exists():
            raise OutputError(f"{folder} holds something else: choose another folder")
        before = read_record(begun, _Begun)
        if not resume:
            raise OutputError(f"{folder} holds a comparison: `resume=True` goes on with it")
        if before.told != told or seed not in (None, before.seed):
            raise OutputError(f"{folder} holds a comparison with other arguments: give the same ones")
        return before.seed
    seed = FitConfig(seed=seed).seeded().known_seed
    folder.mkdir(parents=True, exist_ok=True)
    write_bytes(folder / KEY, f"{generate_key()}\n".encode())
    (folder / KEY).chmod(0o600)
    write_record(begun, _Begun(told=told, seed=seed))
    return seed


def _plain(
    out: Path,
    scene: PathLike,
    config: FitConfig,
    width: int | None,
    device: Backend,
    reporter: Reporter | None,
) -> Path:
    """A plain model, fitted once."""
    if not (out / MODEL).exists():
        resume = read_manifest(out).running is not None
        fit(scene, config=config, width=width, device=device, out=out, resume=resume, reporter=reporter)
    return out / MODEL


def _measured(name: str, method: Method, run: HidingRun, device: Backend) -> ComparedMethod:
    """The row of a finished run."""
    target = resolve_device(device)
    scenes, stego = run.scenes(train_pictures=False), run.stego.to(target)
    models = [stego, run.opened[0].reveal(stego).to(target)]
    plains = run.plain_models()
    changed = after_changes(stego, run.reopeners, scenes[0], scenes[1:], changes=[random_pruning(_LOST)])
    pruned = [changed[-1].cover, *changed[-1].secrets]
    metrics = run.metrics
    quality = [metrics.cover, metrics.secrets[0]]
    found = []
    for index, (scene, model, plain) in enumerate(zip(scenes, models, plains, strict=True)):
        photos = [(picture_name(view.camera), view.image) for view in scene.test]
        pictures = renders_of(model, scene, scene.test)
        beside = plain.to(target) if plain is not None else model
        after: ChangedQuality | None = pruned[index]
        found.append(
            SceneScores(
                psnr=quality[index].psnr,
                ssim=quality[index].ssim,
                lpips=compare_images(photos, pictures, flip=False).mean.lpips_alex,
                render_ratio=render_time(name, model, beside, scene, rounds=_ROUNDS).ratio,
                pruned_loss=after.loss if after is not None and after.opens else None,
            )
        )
    return ComparedMethod(
        name=name,
        capabilities=method.capabilities,
        most_secrets=method.most_secrets,
        cover=found[0],
        secret=found[1],
        wrong_keys=None if metrics.wrong_key is None else metrics.wrong_key.vs_cover.mean,
        steps=metrics.iterations,
        gaussians=metrics.gaussians,
        published_bytes=stego_in(run.folder).stat().st_size,
        handed_bytes=sum(path.stat().st_size for path in (run.folder / HANDED).glob("*")),
        seconds=metrics.seconds,
    )


def _runs(folder: Path, found: Comparison) -> list[tuple[str, HidingRun]]:
    """Those that came to something, by name."""
    key = read_text(folder / KEY).strip()
    return [
        (each.name, open_run(folder / each.name.replace(":", "-"), [key] if each.capabilities.keys else []))
        for each in found.methods
        if each.error is None
    ]


def _sheet(runs: Sequence[tuple[str, HidingRun]], device: Backend) -> Image.Image:
    """A row for each method: cover, secret and its error (times 4) from the middle test camera."""
    target = resolve_device(device)
    rows: list[tuple[str, list[NDArray[np.uint8]]]] = []
    for name, run in runs:
        stego = run.stego.to(target)
        shown = []
        for scene, model in zip(
            run.scenes(train_pictures=False), [stego, run.opened[0].reveal(stego).to(target)], strict=True
        ):
            view = scene.test[len(scene.test) // 2]
            shown.append((view.image.numpy(), renders_of(model, scene, [view])[0][1].numpy()))
        error = np.abs(shown[1][0].astype(int) - shown[1][1]).clip(0, 63).astype(np.uint8) * 4
        if not rows:
            rows.append(("photos", [shown[0][0], shown[1][0], np.zeros_like(error)]))
        rows.append((name, [shown[0][1], shown[1][1], error]))
    return _drawn(rows)


def _drawn(rows: Sequence[tuple[str, Sequence[NDArray[np.uint8]]]], cell: int = 240) -> Image.Image:
    """Rows of pictures [H, W, 3], each scaled to `cell` pixels' width, beside their names."""
    gap, label = cell // 40, cell // 2
    heights = [max(round(each.shape[0] * cell / each.shape[1]) for each in pictures) for _, pictures in rows]
    columns = max((len(pictures) for _, pictures in rows), default=0)
    size = label + columns * (cell + gap) + gap, cell // 8 + sum(heights) + gap * (len(rows) + 1)
    sheet = Image.new("RGB", size, "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(cell // 17)
    for index, head in enumerate(("cover", "secret", "error of the secret, x4")[:columns]):
        draw.text((label + index * (cell + gap), gap), head, fill=(20, 20, 20), font=font)
    y = cell // 8
    for (name, pictures), height in zip(rows, heights, strict=True):
        draw.text((gap, y + gap), name, fill=(20, 20, 20), font=font)
        for index, each in enumerate(pictures):
            picture = Image.fromarray(each)
            scaled = picture.resize((cell, round(each.shape[0] * cell / each.shape[1])))
            sheet.paste(scaled, (label + index * (cell + gap), y))
        y += height + gap
    return sheet
