"""`render` and `evaluate`: pictures of models, and their measures on test views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Literal

from torch import Tensor

from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene, View
from keyss.files.images import png_bytes
from keyss.measure.hiding import WRONG_KEYS, measure_hiding
from keyss.measure.images import renders_of
from keyss.rendering import Backend, resolve_device
from keyss.runs.config import Background, PathLike
from keyss.runs.files import METRICS, writers
from keyss.runs.folder import RunFolder, write_again
from keyss.runs.metrics import HideMetrics
from keyss.runs.opening import as_model, as_scene, open_run
from keyss.runs.records import write_record

Split = Literal["test", "train", "all"]


def render(
    model: PathLike | Gaussians,
    cameras: PathLike | Scene,
    *,
    split: Split = "test",
    width: int | None = None,
    background: Background = None,
    skip_missing: bool = False,
    device: Backend = "auto",
    out: PathLike | None = None,
    overwrite: bool = False,
) -> list[tuple[str, Tensor]]:
    """Pictures of a model from a scene's cameras: their names and uint8 images [H, W, 3].

    `width`, `background`, `skip_missing`: see `load_scene`; a photo that is left out has no camera. `out` (a
    folder) gets a PNG per camera.
    """
    target = resolve_device(device)
    inputs = [Path(model)] if isinstance(model, str | Path) else []
    folder = RunFolder(out, "render", inputs=inputs, overwrite=overwrite) if out is not None else None
    gaussians = as_model(model).to(target)
    scene = as_scene(cameras, width, background, skip_missing=skip_missing)
    views: dict[str, tuple[View, ...]] = {"test": scene.test, "train": scene.train, "all": scene.views}
    pictures = renders_of(gaussians, scene, views[split])
    if folder:
        with folder.work():
            folder.write(writers({name: png_bytes(image) for name, image in pictures}))
    return pictures


def evaluate(
    run: PathLike,
    keys: Sequence[str],
    *,
    wrong_keys: int | None = None,
    seed: int | None = None,
    device: Backend = "auto",
) -> HideMetrics:
    """Measure a folder that `hide` made again, from its files and the test views; rewrites its
    `metrics.json`.

    `keys`: those of all its secrets, in any order. `wrong_keys`: number of random wrong keys to measure, 32
    by default, drawn from `seed`, by default the run's own; only for methods whose keys condition a decoder.
    Raises WrongKeyError for a key that opens nothing, UsageError for a secret without a key.
    """
    target = resolve_device(device)
    opened = open_run(run, keys)
    if (wrong_keys, seed) != (None, None) and all(each.decode is None for each in opened.opened):
        raise UsageError(
            f"wrong keys show nothing of what the method {opened.config.method} hid: there is no decoder; "
            "leave out their number and seed"
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
    write_again(opened.folder, "hide", METRICS, partial(write_record, record=metrics))
    return metrics
