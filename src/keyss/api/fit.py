"""`fit`: a plain 3DGS model of a scene."""

from __future__ import annotations

import time
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path

from keyss.core.errors import InputError
from keyss.core.scene import Scene, ViewOptions
from keyss.fitting.config import FitConfig, preset_for
from keyss.fitting.image_metrics import quality
from keyss.fitting.plain import FitResult, fit_scene
from keyss.progress import Reporter, reporter as default_reporter
from keyss.rendering import Backend, resolve_device
from keyss.rendering.orbit import is_model
from keyss.runs.files import CONFIG, METRICS, MODEL, PathLike, as_scene, path_of
from keyss.runs.folder import RunFolder
from keyss.runs.planning import check_room, cost_of_fit
from keyss.runs.run_records import FitMetrics, FitRunConfig, with_seed


def fit(
    scene: PathLike | Scene,
    *,
    config: FitConfig | None = None,
    views: ViewOptions = ViewOptions(),
    device: Backend = "auto",
    out: PathLike | None = None,
    overwrite: bool = False,
    resume: bool = False,
    reporter: Reporter | None = None,
) -> FitResult:
    """Train plain 3DGS on a scene.

    `config`: by default 1,000 steps and 30,000 Gaussians, on CUDA 30,000 and a million. `views`: how photos
    are read. `out` (a folder) gets `model.ply`, and `private/` with `config.json`, `metrics.json` and
    checkpoints, from which `resume` continues. Without a seed in `config` the run uses a random one, which
    `config.json` records. `reporter`: by default progress on the standard error stream;
    `keyss.progress.Reporter()` is silent. Raises KeyssError, and Interrupted on Ctrl-C.
    """
    started, reporter = time.monotonic(), reporter or default_reporter()
    if is_model(scene):
        raise InputError(f"{scene}: expected a folder of posed photos, found a 3DGS model")
    interrupted = Path(out) if resume and out is not None else None
    target = resolve_device(device)
    config = with_seed(config or preset_for("default", target.type), interrupted, "config")
    settings = FitRunConfig(scene=path_of(scene), views=views, config=config)
    folder = None
    if out is not None:
        folder = RunFolder(
            out,
            "fit",
            asdict(settings),
            writes=(MODEL, CONFIG, METRICS),
            overwrite=overwrite,
            resume=resume,
        )
    loaded = as_scene(scene, views)
    cost = cost_of_fit(loaded, config, target)
    check_room(cost, None if out is None else Path(out))
    if not resume and cost.is_long:
        reporter.note(f"fit: {cost}")
    with folder.work() if folder else nullcontext():
        result = fit_scene(
            loaded,
            config,
            device=target,
            title=f"fit {loaded.name}",
            checkpoint=folder.checkpoints / "fit.safetensors" if folder else None,
            resume=resume,
            reporter=reporter,
        )
        if folder:
            test = quality(result.gaussians.to(target), loaded.test, loaded.background.to(target))
            metrics = FitMetrics(
                **asdict(test),
                gaussians=len(result.gaussians),
                iterations=config.iterations,
                seconds=round(folder.earlier_seconds + time.monotonic() - started, 1),
                width=loaded.train[0].camera.width,
                seed=config.known_seed,
            )
            folder.write({MODEL: result.gaussians, CONFIG: settings, METRICS: metrics})
    return result
