"""Hiding by carrying, from files or scenes: what `keyss hide --method carry` does."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeGuard

import torch
from torch import Tensor

from keyss._version import __version__
from keyss.core.gaussians import Gaussians
from keyss.core.pruning_compensation import compensate_pruning
from keyss.core.scene import Scene
from keyss.files.models import is_model_path, read_model
from keyss.files.output import OutputFolder
from keyss.files.scenes import load_scene
from keyss.fitting.config import FitConfig
from keyss.fitting.image_metrics import quality
from keyss.fitting.loop import Reporter
from keyss.fitting.plain import fit_scene
from keyss.methods.carry.carrying import (
    Carried,
    Carriers,
    derive_all,
    embed_derived,
    extract_derived,
    usable_carriers,
)
from keyss.methods.carry.dither import cost, dither
from keyss.methods.carry.plan import Size, check_degrees, room, thinned
from keyss.methods.carry.thinning import most_visible
from keyss.runs.files import CONFIG, METRICS, STEGO, json_writer, plain_names, ply_writer

Given = Path | str | Scene | Gaussians
Quality = dict[str, float] | None  # PSNR and SSIM against the test photos, None without photos


@dataclass(frozen=True)
class Source:
    """A model of the cover or of a secret, and the scene with its photos if there is one."""

    gaussians: Gaussians
    scene: Scene | None
    fitted: bool = False  # here, and not given

    def quality(self, gaussians: Gaussians, device: torch.device) -> Quality:
        """Of `gaussians` against the photos."""
        return _quality(self.scene, gaussians, device)


@dataclass(frozen=True)
class PlainModels:
    """Where models come from: files, memory, or the photos of scenes, to which they are fitted."""

    width: int | None  # photos are shrunk to it
    background: Tensor | Sequence[float] | None  # see `load_scene`
    config: FitConfig
    device: torch.device
    folder: OutputFolder | None = None  # for checkpoints
    resume: bool = False
    reporter: Reporter | None = None

    def source(self, index: int, given: Given, model: Path | str | Gaussians | None = None) -> Source:
        """What is given: a .ply file, a model, or a scene, with its `model` or one that is fitted to it.

        `index`: 0 for the cover, from 1 on for secrets.
        """
        if isinstance(given, Gaussians):
            return Source(given.to("cpu"), None)
        if _is_model(given):
            return Source(read_model(given), None)
        scene = _photos(given, self.width, self.background)
        if model is not None:
            return Source(model.to("cpu") if isinstance(model, Gaussians) else read_model(model), scene)
        result = fit_scene(
            scene,
            self.config,
            device=self.device,
            title=f"plain model of {'the cover' if index == 0 else f'secret {index}'} ({scene.name})",
            checkpoint=self.folder.checkpoints() / f"plain-{index}.safetensors" if self.folder else None,
            resume=self.resume,
            reporter=self.reporter,
        )
        return Source(result.gaussians.to("cpu"), scene, fitted=True)


@dataclass(frozen=True)
class CarryResult:
    """A cover that carries its secrets."""

    stego: Gaussians
    opened: tuple[Carried, ...]  # the secrets as they come out again
    metrics: dict[str, Any]


def carry(
    cover: Source,
    secrets: Sequence[tuple[str, Source]],
    *,
    thin: bool = False,
    dithered: bool = False,
    device: torch.device | str = "cpu",
) -> CarryResult:
    """Carry every (key, secret) in the cover, open each again as its reader will, and measure.

    `thin`: of secrets that are too large the least visible Gaussians are left out. `dithered`: the cover gets
    new low bits where they are not random. Raises UsageError for equal keys and secrets that are too large,
    InputError for a cover whose low bits are not random.
    """
    device, start = torch.device(device), time.monotonic()
    models = [source.gaussians for _, source in secrets]
    sizes = [Size(len(model), model.sh_degree) for model in models]
    check_degrees(sizes, cover.gaussians.sh_degree)
    carrier = dither(cover.gaussians, os.urandom(32)) if dithered else cover.gaussians
    usable = usable_carriers(carrier)
    count = int(usable.sum())
    if thin:
        counts = thinned(sizes, count, carrier.sh_degree)
        models = [most_visible(model, kept) for model, kept in zip(models, counts, strict=True)]
    keys = derive_all(carrier, [key for key, _ in secrets])
    stego = embed_derived(carrier, list(zip(keys, models, strict=True)), usable=usable)
    written = Carriers.of(stego)
    opened = tuple(extract_derived(written, own[0]) for own in keys)
    seconds = time.monotonic() - start
    if [len(carried.gaussians) for carried in opened] != [len(model) for model in models]:
        raise RuntimeError("what was written does not open again as it should")
    metrics = {
        "method": "carry",
        "gaussians": len(carrier),
        "carriers": count,
        "room": room(sizes, count, carrier.sh_degree),
        "dither_psnr": round(cost(cover.gaussians, carrier), 1) if dithered else None,
        "cover": cover.quality(stego, device),
        "secrets": [
            {
                "gaussians": size.count,
                "carried": len(carried.gaussians),
                "bits": carried.bits,
                **(source.quality(carried.gaussians, device) or {}),
            }
            for size, carried, (_, source) in zip(sizes, opened, secrets, strict=True)
        ],
        "bound": {
            "cover": cover.quality(cover.gaussians, device),
            "secrets": [source.quality(source.gaussians, device) for _, source in secrets],
        },
        "seconds": round(seconds, 2),
    }
    return CarryResult(stego, opened, metrics)


def hide(
    given: Sequence[tuple[Given, Path | str | Gaussians | None]],
    keys: Sequence[str],
    plain: PlainModels,
    *,
    thin: bool,
    dithered: bool,
) -> tuple[Gaussians, dict[str, Any]]:
    """The stego model and the metrics; the folder of `plain` gets them, and models that were fitted.

    `given`: the cover, then the secrets, each with its plain model if there is one. Errors as for `carry`.
    """
    sources = [plain.source(index, each, model) for index, (each, model) in enumerate(given)]
    secrets = list(zip(keys, sources[1:], strict=True))
    result = carry(sources[0], secrets, thin=thin, dithered=dithered, device=plain.device)
    metrics = result.metrics | {"version": __version__}
    if plain.folder is not None:
        background = plain.background
        names = [_name(each) for each, _ in given]
        settings = {
            "method": "carry",
            "cover": names[0],
            "secrets": names[1:],
            "models_given": [not source.fitted for source in sources],
            "width": plain.width,
            "background": None if background is None else [float(x) for x in background],
            "thin": thin,
            "dither": dithered,
            "payloads": [carried.fingerprint() for carried in result.opened],
            "config": {"fit": asdict(plain.config)},
            "version": __version__,
        }
        writers: dict[str, Callable[[Path], None]] = {
            STEGO: ply_writer(result.stego),
            CONFIG: json_writer(settings),
            METRICS: json_writer(metrics),
        }
        for name, source in zip(plain_names(len(secrets)), sources, strict=True):
            if source.scene is not None:  # else it is the .ply that was given
                writers[name] = ply_writer(source.gaussians)
        plain.folder.fill(writers)
    return result.stego, metrics


def evaluate(
    metrics: dict[str, Any],
    stego: Gaussians,
    opened: Sequence[Carried],
    sources: Sequence[str],  # of the cover, then of the secrets: scene folders, or models without photos
    width: int | None,
    background: Tensor | Sequence[float] | None,
    device: torch.device | str,
) -> dict[str, Any]:
    """`metrics` with the stego model and what keys opened in it measured against the photos again."""
    models = [stego, *(compensate_pruning(carried.gaussians, carried.count) for carried in opened)]
    found = []
    for source, model in zip(sources, models, strict=True):
        scene = None if _is_model(source) else _photos(source, width, background)
        found.append(_quality(scene, model, torch.device(device)))
    before = metrics.get("secrets") or [{}] * len(opened)
    secrets = [was | (now or {}) for was, now in zip(before, found[1:], strict=True)]
    return metrics | {"cover": found[0], "secrets": secrets}


def _is_model(given: Path | str | Scene) -> TypeGuard[Path | str]:
    return not isinstance(given, Scene) and is_model_path(given)


def _photos(
    given: Path | str | Scene, width: int | None, background: Tensor | Sequence[float] | None
) -> Scene:
    return given if isinstance(given, Scene) else load_scene(given, width=width, background=background)


def _name(given: Given) -> str | None:
    """Where it can be found again, None for what is in memory."""
    return None if isinstance(given, Scene | Gaussians) else str(Path(given).resolve())


def _quality(scene: Scene | None, gaussians: Gaussians, device: torch.device) -> Quality:
    if scene is None:
        return None
    return asdict(quality(gaussians.to(device), scene.test, scene.background.to(device)))
