"""`render(video=...)`: a model, or two with a wipe between them, as a video."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Camera, Scene, ViewOptions, checked_background
from keyss.files.atomic import check_not_an_input, check_output_file
from keyss.files.images import check_video, write_video
from keyss.progress import Reporter
from keyss.rendering import Backend, render, resolve_device
from keyss.rendering.arguments import MAX_SIDE
from keyss.rendering.orbit import IMAGE_SIZE, around, circle
from keyss.runs.sources import PathLike, as_model, as_scene

FPS = 25
MAX_SECONDS = 600.0

_LINE = 2  # pixels between the two sides of a wipe


def write_film(
    model: PathLike | Gaussians,
    out: PathLike,
    cameras: PathLike | Scene | None,
    views: ViewOptions,
    *,
    wipe: PathLike | Gaussians | None,
    seconds: float,
    device: Backend,
    overwrite: bool,
    reporter: Reporter | None,
) -> None:
    """Write a video of a model; see `keyss.render`."""
    check_video(out)
    inputs = [Path(each) for each in (model, wipe) if isinstance(each, str | Path)]
    check_not_an_input(out, inputs)
    check_output_file(out, overwrite)
    if not (math.isfinite(seconds) and 0 < seconds <= MAX_SECONDS):
        raise UsageError(f"`seconds`: expected more than 0 and at most {MAX_SECONDS:g}, got {seconds}")
    target = resolve_device(device)
    count = frame_count(seconds)
    models = [as_model(each).to(target) for each in (model, wipe) if each is not None]
    if cameras is None:
        size = IMAGE_SIZE if views.width is None else views.width
        if not 2 <= size <= MAX_SIDE:
            raise UsageError(f"`width`: expected 2 to {MAX_SIDE:,} pixels, got {size:,}")
        color = torch.zeros(3) if views.background is None else checked_background(views.background)
        paths = [circle(each, size - size % 2, count) for each in models]
    else:
        scene = as_scene(cameras, views)
        color = scene.background
        paths = [[_even(camera) for camera in around([view.camera for view in scene.views], count)]]
        paths *= len(models)
    reporter = reporter or Reporter()
    reporter.start(f"video {Path(out).name}", count, 0)
    try:
        write_video(out, _frames(models, paths, color.to(target), reporter), FPS)
    finally:
        reporter.finish()


@torch.no_grad()
def _frames(
    models: Sequence[Gaussians], paths: Sequence[Sequence[Camera]], color: Tensor, reporter: Reporter
) -> Iterator[npt.NDArray[np.uint8]]:
    count = len(paths[0])
    for index in range(count):
        pictures = [
            (render(model, path[index], color).clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
            for model, path in zip(models, paths, strict=True)
        ]
        yield pictures[0] if len(pictures) == 1 else wiped(pictures[0], pictures[1], shown(index / count))
        reporter.update(index + 1, 0, {})


def frame_count(seconds: float) -> int:
    """Frames of a video."""
    return max(1, round(seconds * FPS))


def shown(time: float) -> float:
    """How much of the second model a wipe shows at `time`, from 0 to 1: none, all at a half, none again."""
    return 0.5 - 0.5 * math.cos(2 * math.pi * time)


def wiped(first: npt.NDArray[np.uint8], second: npt.NDArray[np.uint8], share: float) -> npt.NDArray[np.uint8]:
    """`first` [H, W, 3] with the left `share` of `second` over it, and a white line between them."""
    edge = round(share * first.shape[1])
    picture = np.concatenate([second[:, :edge], first[:, edge:]], axis=1)
    if 0 < edge < first.shape[1]:
        picture[:, max(0, edge - _LINE // 2) : edge + _LINE // 2] = 255
    return picture


def _even(camera: Camera) -> Camera:
    """Without its last column or row where their number is odd, for films have no colour there."""
    width, height = camera.width - camera.width % 2, camera.height - camera.height % 2
    if min(width, height) < 2:
        raise UsageError(f"pictures of {camera.width} x {camera.height} pixels are too small for a film")
    return Camera(camera.viewmat, camera.K, width, height, camera.name)
