"""`render` and `evaluate`: images and videos of models, and measurements on test views."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from keyss.core.arrays import Bytes
from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Camera, Scene, View, ViewOptions, checked_background
from keyss.files.atomic import check_not_an_input, check_output_file
from keyss.files.images import check_video, png_bytes, write_video
from keyss.measure.hide_quality import WRONG_KEYS, compare, measure_hiding
from keyss.measure.renders import renders_of
from keyss.progress import Reporter
from keyss.rendering import Backend, render as render_view, resolve_device
from keyss.rendering.orbit import IMAGE_SIZE, around, circle
from keyss.rendering.rasterization_checks import MAX_SIDE
from keyss.runs.files import METRICS, Background, PathLike, as_model, as_scene
from keyss.runs.folder import RunFolder, write_again
from keyss.runs.open_run import open_run
from keyss.runs.run_records import HideMetrics

Split = Literal["test", "train", "all"]
FPS = 25
MAX_SECONDS = 600.0

_LINE = 2  # pixels between the two sides of a wipe


def render(
    model: PathLike | Gaussians,
    cameras: PathLike | Scene | None = None,
    *,
    split: Split = "test",
    width: int | None = None,
    background: Background = None,
    skip_missing: bool = False,
    video: PathLike | None = None,
    wipe: PathLike | Gaussians | None = None,
    seconds: float = 8.0,
    device: Backend = "auto",
    out: PathLike | None = None,
    overwrite: bool = False,
    reporter: Reporter | None = None,
) -> list[tuple[str, Tensor]]:
    """Render a model from the cameras of a scene; returns names and uint8 images [H, W, 3].

    `width`, `background`, `skip_missing`: see `load_scene`; a skipped photo has no camera. `out` (a folder)
    gets a PNG for each camera.

    With `video` (an .mp4 of 25 frames per second) it writes a video instead, and returns no images. The
    camera circles the model; with `cameras`, it circles their focus at their height. `wipe`: a second model,
    wiped in from the left and out again; without `cameras` each model has a circle of its own. `width` is
    then 400 pixels by default, and sizes are rounded to even numbers. Raises KeyssError.
    """
    views = ViewOptions.of(width, background, skip_missing)
    if video is not None:
        _write_film(model, video, cameras, views, wipe, seconds, device, overwrite, reporter)
        return []
    if cameras is None:
        raise UsageError("images need `cameras`, a scene; without one, only a `video` can be rendered")
    target = resolve_device(device)
    inputs = [Path(model)] if isinstance(model, str | Path) else []
    folder = RunFolder(out, "render", inputs=inputs, overwrite=overwrite) if out is not None else None
    scene = as_scene(cameras, views)
    gaussians = scene.to_scene_frame(as_model(model)).to(target)
    splits: dict[str, tuple[View, ...]] = {"test": scene.test, "train": scene.train, "all": scene.views}
    pictures = renders_of(gaussians, scene, splits[split])
    if folder:
        with folder.work():
            folder.write({name: png_bytes(image) for name, image in pictures})
    return pictures


def evaluate(
    run: PathLike,
    keys: Sequence[str],
    *,
    wrong_keys: int | None = None,
    seed: int | None = None,
    device: Backend = "auto",
) -> HideMetrics:
    """Measure a run of `hide` again on the test views; rewrites its `metrics.json`.

    `keys`: one per secret, in any order. `wrong_keys`: number of random wrong keys to measure, 32 by default,
    sampled with `seed`, by default the run's; only for methods whose keys condition a decoder.
    Raises WrongKeyError for a key that opens nothing, UsageError for a secret without a key.
    """
    target = resolve_device(device)
    opened = open_run(run, keys)
    if (wrong_keys, seed) != (None, None) and all(each.decode is None for each in opened.opened):
        raise UsageError(
            f"the method {opened.config.method} has no decoder, so wrong keys show nothing: leave out "
            "`wrong_keys` and `seed`"
        )
    stego, scenes = opened.stego.to(target), opened.scenes(train_pictures=False)
    models = [stego, *(secret.reveal(stego).to(target) for secret in opened.opened)]
    baselines = [None if model is None else model.to(target) for model in opened.baselines()]
    measured = measure_hiding(
        stego,
        opened.opened,
        scenes,
        list(map(compare, models, baselines, scenes)),
        [None if model is None else len(model) for model in baselines],
        steps=opened.metrics.baseline.steps,
        equal=opened.metrics.baseline.equal,
        wrong_keys=WRONG_KEYS if wrong_keys is None else wrong_keys,
        seed=opened.metrics.seed if seed is None else seed,
    )
    metrics = replace(opened.metrics, **vars(measured))
    write_again(opened.folder, "hide", METRICS, metrics)
    return metrics


def _write_film(
    model: PathLike | Gaussians,
    out: PathLike,
    cameras: PathLike | Scene | None,
    views: ViewOptions,
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
        models = [scene.to_scene_frame(each) for each in models]
        paths = [[_crop_to_even(camera) for camera in around([view.camera for view in scene.views], count)]]
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
) -> Iterator[Bytes]:
    count = len(paths[0])
    for index in range(count):
        pictures = [
            (render_view(model, path[index], color).clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
            for model, path in zip(models, paths, strict=True)
        ]
        yield pictures[0] if len(pictures) == 1 else wiped(pictures[0], pictures[1], shown(index / count))
        reporter.update(index + 1, 0, {})


def frame_count(seconds: float) -> int:
    """Frames of a video."""
    return max(1, round(seconds * FPS))


def shown(time: float) -> float:
    """Share of the second model that a wipe shows at `time` in [0, 1]: 0 at both ends, 1 in the middle."""
    return 0.5 - 0.5 * math.cos(2 * math.pi * time)


def wiped(first: Bytes, second: Bytes, share: float) -> Bytes:
    """`first` [H, W, 3] with the left `share` of `second` over it, and a white line between them."""
    edge = round(share * first.shape[1])
    picture = np.concatenate([second[:, :edge], first[:, edge:]], axis=1)
    if 0 < edge < first.shape[1]:
        picture[:, max(0, edge - _LINE // 2) : edge + _LINE // 2] = 255
    return picture


def _crop_to_even(camera: Camera) -> Camera:
    """Drop the last column or row if their number is odd: video codecs cannot store its colour."""
    width, height = camera.width - camera.width % 2, camera.height - camera.height % 2
    if min(width, height) < 2:
        raise UsageError(f"pictures of {camera.width} x {camera.height} pixels are too small for a film")
    return replace(camera, width=width, height=height)
