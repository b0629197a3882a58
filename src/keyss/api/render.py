"""`render` and `evaluate`: images of models, and measurements on test views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene, ViewOptions, checked_background
from keyss.files.atomic import check_not_an_input, check_output_file, write_bytes
from keyss.files.images import animation_bytes, png_bytes
from keyss.measure.hide_quality import WRONG_KEYS, compare, measure_without_keys
from keyss.measure.renders import renders_of
from keyss.progress import Reporter, reporter as default_reporter
from keyss.rendering import Backend, resolve_device
from keyss.rendering.orbit import checked_size, turntable
from keyss.runs.estimates import seconds_for
from keyss.runs.files import METRICS, PathLike, as_model, as_scene, stego_in
from keyss.runs.folder import RunFolder, write_again
from keyss.runs.open_run import open_run
from keyss.runs.planning import view_seconds
from keyss.runs.run_records import HideMetrics

Split = Literal["test", "train", "all"]

_OTHER_FILES = (".apng", ".avif", ".gif", ".jpeg", ".jpg", ".mkv", ".mov", ".mp4", ".png", ".webm")


def render(
    model: PathLike | Gaussians,
    cameras: PathLike | Scene | None = None,
    *,
    split: Split = "test",
    views: ViewOptions = ViewOptions(),
    device: Backend = "auto",
    out: PathLike | None = None,
    overwrite: bool = False,
) -> list[tuple[str, Tensor]]:
    """Render a model from the cameras of a scene, by default all around it; names and uint8 images [H, W, 3].

    `views`: how the scene is read; a skipped photo has no camera. Without `cameras`, 60 square images of
    `views.width` pixels, by default 400. `out` gets a PNG for each camera if it is a folder, or
    an animation if its name ends in .webp; names of other pictures and films are errors. Raises KeyssError.
    """
    target = resolve_device(device)
    inputs = [Path(model)] if isinstance(model, str | Path) else []
    suffix = "" if out is None else Path(out).suffix.lower()
    if suffix in _OTHER_FILES:
        raise UsageError(
            f"{out}: animations are .webp files; any other name is a folder for images, not a {suffix}"
        )
    animated = suffix == ".webp"
    folder = None
    if animated:
        check_not_an_input(str(out), inputs)
        check_output_file(str(out), overwrite)
    elif out is not None:
        folder = RunFolder(out, "render", inputs=inputs, overwrite=overwrite)
    if cameras is None:
        gaussians = as_model(model).to(target)
        background = torch.zeros(3) if views.background is None else checked_background(views.background)
        chosen = turntable(gaussians, checked_size(views.width))
    else:
        scene = as_scene(cameras, views)
        gaussians, background = scene.to_scene_frame(as_model(model)).to(target), scene.background
        chosen = [
            view.camera for view in {"test": scene.test, "train": scene.train, "all": scene.views}[split]
        ]
    pictures = renders_of(gaussians, chosen, background)
    if animated:
        write_bytes(str(out), animation_bytes([image for _, image in pictures]))
    if folder:
        with folder.work():
            folder.write({name: png_bytes(image) for name, image in pictures})
    return pictures


def evaluate(
    run: PathLike,
    keys: Sequence[str],
    *,
    wrong_keys: int | None = None,
    device: Backend = "auto",
    reporter: Reporter | None = None,
) -> HideMetrics:
    """Measure a run of `hide` again on the test views; rewrites its `metrics.json`.

    `keys`: one per secret, in any order. `wrong_keys`: number of random wrong keys to measure, 32 by default;
    only for methods whose keys condition a decoder. Raises WrongKeyError for a key that opens nothing,
    UsageError for a secret without a key.
    """
    target, reporter = resolve_device(device), reporter or default_reporter()
    with reporter.waiting("opening the secrets", len(keys) * seconds_for("reveal", stego_in(Path(run)))):
        opened = open_run(run, keys)
    if wrong_keys is not None and all(secret.decode is None for secret in opened.opened):
        raise UsageError(
            f"the method {opened.config.method} has no decoder, so wrong keys show nothing: leave out "
            "`wrong_keys`"
        )
    stego = opened.stego.to(target)
    with reporter.waiting("reading the scenes", seconds_for("prepare", stego_in(opened.folder))):
        scenes = opened.scenes(train_pictures=False)
        models = [stego, *(secret.reveal(stego).to(target) for secret in opened.opened)]
        baselines = [None if model is None else model.to(target) for model in opened.baselines()]
    tries = WRONG_KEYS if wrong_keys is None else wrong_keys
    decoded = tries * sum(secret.decode is not None for secret in opened.opened)
    seconds = sum(
        (1 + decoded) * len(scene.test) * view_seconds(target.type, len(model), scene)
        for model, scene in zip(models, scenes, strict=True)
    )
    with reporter.waiting("comparing renders", seconds):
        shown = list(map(compare, models, baselines, scenes))
        baseline = replace(
            opened.metrics.baseline,
            cover=shown[0].plain,
            secrets=tuple(render.plain for render in shown[1:]),
            gaussians=tuple(None if model is None else len(model) for model in baselines),
        )
        wrong, chance = measure_without_keys(
            stego, opened.opened, scenes, wrong_keys=tries, seed=opened.metrics.seed
        )
    metrics = replace(
        opened.metrics,
        cover=shown[0].quality,
        secrets=tuple(render.quality for render in shown[1:]),
        baseline=baseline,
        wrong_key=wrong,
        chance_level=chance,
    )
    write_again(opened.folder, "hide", METRICS, metrics)
    return metrics
