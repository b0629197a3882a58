"""`render` and `evaluate`: images of models, and measurements on test views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

from torch import Tensor

from keyss.api.filming import write_film
from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene, View, ViewOptions
from keyss.files.images import png_bytes
from keyss.measure.hiding import WRONG_KEYS, measure_hiding
from keyss.measure.images import renders_of
from keyss.progress import Reporter
from keyss.rendering import Backend, resolve_device
from keyss.runs.files import METRICS
from keyss.runs.folder import RunFolder, write_again
from keyss.runs.metrics import HideMetrics
from keyss.runs.opening import open_run
from keyss.runs.sources import Background, PathLike, as_model, as_scene

Split = Literal["test", "train", "all"]


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

    With `video` (an .mp4 of 25 frames a second) it writes that instead, and returns no images. The camera
    circles the model; with `cameras`, it circles what they look at, at their height. `wipe`: a second model,
    which is uncovered from the left and covered again; without `cameras` each model has a circle of its own.
    `width` is then 400 pixels by default, and sizes are rounded to even numbers. Raises KeyssError and its
    children.
    """
    views = ViewOptions.of(width, background, skip_missing)
    if video is not None:
        write_film(
            model,
            video,
            cameras,
            views,
            wipe=wipe,
            seconds=seconds,
            device=device,
            overwrite=overwrite,
            reporter=reporter,
        )
        return []
    if cameras is None:
        raise UsageError("images need `cameras`, a scene; without one, only a `video` can be rendered")
    target = resolve_device(device)
    inputs = [Path(model)] if isinstance(model, str | Path) else []
    folder = RunFolder(out, "render", inputs=inputs, overwrite=overwrite) if out is not None else None
    gaussians = as_model(model).to(target)
    scene = as_scene(cameras, views)
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

    `keys`: those of all its secrets, in any order. `wrong_keys`: number of random wrong keys to measure, 32
    by default, sampled with `seed`, by default the run's; only for methods whose keys condition a decoder.
    Raises WrongKeyError for a key that opens nothing, UsageError for a secret without a key.
    """
    target = resolve_device(device)
    opened = open_run(run, keys)
    if (wrong_keys, seed) != (None, None) and all(each.decode is None for each in opened.opened):
        raise UsageError(
            f"the method {opened.config.method} has no decoder, so wrong keys show nothing: leave out "
            "`wrong_keys` and `seed`"
        )
    measured = measure_hiding(
        opened.stego.to(target),
        opened.opened,
        opened.scenes(train_pictures=False),
        [None if model is None else model.to(target) for model in opened.baselines()],
        steps=opened.metrics.baseline.steps,
        equal=opened.metrics.baseline.equal,
        wrong_keys=WRONG_KEYS if wrong_keys is None else wrong_keys,
        seed=opened.metrics.seed if seed is None else seed,
    )
    metrics = replace(opened.metrics, **vars(measured))
    write_again(opened.folder, "hide", METRICS, metrics)
    return metrics
