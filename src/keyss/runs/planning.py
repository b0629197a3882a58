"""Plans of runs: room, disk, memory, and a rough time.

Sizes follow from the models and the options. Times come from constants.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import psutil
import torch

from keyss.channels import Format
from keyss.core.errors import OutputError
from keyss.core.scene import Scene
from keyss.fitting.config import FitConfig
from keyss.fitting.losses import Targets
from keyss.methods.base import Method, MethodOptions, Plan, Source, Stage, role_of
from keyss.methods.plain_models import Bound, plain_stage
from keyss.progress import about

_LONG = 1000  # steps
_KEY_SECONDS = 3.0  # for each secret: deriving its key for every salt, and opening it again
_RENDERS = 6  # of each test view, to measure
_STATE_COPIES = 3  # numbers in a checkpoint for each number of a model: itself and two moments
_MAX_APPENDED = 7  # Gaussians that hold one Gaussian of a secret of SH degree 3
# About the most bytes of a packed Gaussian without harmonics, and of each of these.
_PACKED: dict[Format, tuple[float, float]] = {"spz": (15, 0.3), "sog": (18, 0.7), "compressed-ply": (16.3, 1)}
_PACKED_APPENDED: dict[Format, float] = {"spz": 12, "sog": 15, "compressed-ply": 61.3}  # bytes
_OTHER_BYTES = 4 << 20  # JSON files, locks, and the overhead of the file system


def plan_hiding(
    method: Method,
    options: MethodOptions,  # prepared
    sources: Sequence[Source],  # the cover, then the secrets, loaded at least with their test images
    device: torch.device,
    out: Path | None,
    *,
    bound: bool = False,
) -> Plan:
    """The plan of a hiding. Writes nothing.

    `bound`: fit plain 3DGS of as many steps as each scene has, if these are more than its plain model has.
    """
    plan, fit, count = method.plan(sources, options), options.fit, len(sources)
    sizes, configs = _sizes(options, sources), options.fits(count)
    stages, bounds = [], []
    for index, (source, config, size, training) in enumerate(
        zip(sources, configs, sizes, options.training(count), strict=True)
    ):
        role = role_of(index, count)
        if source.given is None:
            stages.append(_fit_stage(plain_stage(role), config, source.scene, size, device))
        longer = Bound.of(training, config.iterations if source.given is None else None)
        if bound and source.photos and not longer.equal and longer.steps is not None:
            bounds.append(_fit_stage(f"bound of the {role}", longer.config(fit), source.scene, size, device))
    if plan.steps:
        step = sum(
            _step_seconds(device, rendered, source.scene, plan)
            for source, rendered in zip(sources, plan.rendered, strict=True)
            if rendered
        )
        stages.append(Stage("hiding", plan.steps, sum(plan.rendered), plan.steps * fit.views_per_step * step))
    measuring = sum(
        _RENDERS * len(source.scene.test) * _step_seconds(device, size, source.scene) / 3
        for source, size in zip(sources, sizes, strict=True)
    )
    measuring += _KEY_SECONDS * (count - 1)
    stages += [*bounds, Stage("encrypting, opening, measuring", 0, plan.gaussians, measuring)]
    trains = options.trains or any(source.given is None for source in sources)
    notes = plan.notes
    if options.place.grows:
        packed = (
            (_file_bytes(sizes[0], plan.sh_degree, each) + (plan.gaussians - sizes[0]) * appended) / 1e6
            for each, appended in _PACKED_APPENDED.items()
        )
        notes += ("at most {:,.1f} MB as .spz, {:,.1f} as .sog, {:,.1f} as compressed .ply".format(*packed),)
    return replace(
        plan,
        notes=notes,
        method=method.name,
        stages=tuple(stages),
        file_bytes=_file_bytes(plan.gaussians, plan.sh_degree, options.format),
        disk_bytes=_disk_bytes(options, sources),
        free_bytes=None if out is None else _free_bytes(out),
        memory_bytes=_memory_bytes(plan.gaussians, plan.sh_degree, trains)
        + max(Targets.most_bytes(source.scene.train) for source in sources) * trains,
    )


def plan_fit(scene: Scene, config: FitConfig, device: torch.device) -> Plan:
    """The plan of a plain fit."""
    gaussians, degree = config.max_gaussians, config.sh_degree
    file_bytes = _file_bytes(gaussians, degree)
    return Plan(
        gaussians=gaussians,
        sh_degree=degree,
        secret_gaussians=0,
        capacity=0,
        steps=config.iterations,
        stages=(_fit_stage("fit", config, scene, gaussians, device),),
        file_bytes=file_bytes,
        disk_bytes=(1 + 2 * _STATE_COPIES) * file_bytes + _OTHER_BYTES,
        memory_bytes=_memory_bytes(gaussians, degree, trains=True) + Targets.most_bytes(scene.train),
    )


def worth_planning(config: FitConfig) -> bool:
    """True if a training is so long that its estimate is worth a line."""
    return config.iterations >= _LONG


def in_a_line(plan: Plan) -> str:
    """Size of the published file, time, memory and disk of a run."""
    return (
        f"a file of up to {plan.file_bytes / 1e6:,.1f} MB, about {about(plan.seconds)}, "
        f"{plan.memory_bytes / 1e9:.1f} GB of memory, up to "
        f"{plan.disk_bytes / 1e6:,.0f} MB of disk"
    )


def check_disk(out: Path, options: MethodOptions, sources: Sequence[Source]) -> None:
    """Raise OutputError unless there is room for all files of a hiding."""
    needed, free = _disk_bytes(options, sources), _free_bytes(out)
    if free < needed:
        raise OutputError(
            f"{out}: expected {needed / 1e6:,.0f} MB of free space for models and checkpoints, found "
            f"{free / 1e6:,.0f} MB; make room, choose another place, or a smaller `max_gaussians`"
        )


def _sizes(options: MethodOptions, sources: Sequence[Source]) -> list[int]:
    """Upper limits of the Gaussians of the plain models."""
    return [
        config.max_gaussians if source.given is None else len(source.given)
        for source, config in zip(sources, options.fits(len(sources)), strict=True)
    ]


def _disk_bytes(options: MethodOptions, sources: Sequence[Source]) -> int:
    """An upper limit of the bytes on disk at once: results, plain models, and checkpoints being replaced."""
    fit, sizes = options.fit, _sizes(options, sources)
    degrees = [fit.sh_degree if source.given is None else source.given.sh_degree for source in sources]
    models = list(map(_file_bytes, sizes, degrees))
    trained = [size for size, source in zip(models, sources, strict=True) if source.given is None]
    if options.trains:
        models.append(_file_bytes(fit.max_gaussians, fit.sh_degree))
        trained = models
    appended = _MAX_APPENDED * sum(sizes[1:]) if options.place.grows else 0
    published = max(models[0], models[-1]) + _file_bytes(appended, degrees[0])
    return sum(models) + published + 2 * _STATE_COPIES * sum(trained) + _OTHER_BYTES


def _free_bytes(out: Path) -> int:
    """Free bytes on the disk of `out`, which need not exist."""
    folder = Path(os.path.realpath(out))
    while not folder.exists():
        folder = folder.parent
    return shutil.disk_usage(folder).free


def _fit_stage(name: str, config: FitConfig, scene: Scene, gaussians: int, device: torch.device) -> Stage:
    """A plain fit that grows to so many Gaussians."""
    step = _step_seconds(device, 0.75 * gaussians, scene)
    return Stage(name, config.iterations, gaussians, config.iterations * config.views_per_step * step)


def _step_seconds(device: torch.device, gaussians: float, scene: Scene, plan: Plan | None = None) -> float:
    """A training step with one view, and with the networks of a plan; rendering alone takes a third."""
    camera = scene.test[0].camera
    pixels = camera.width * camera.height
    weights = plan.gaussian_weights * plan.gaussians + plan.pixel_weights * pixels if plan else 0.0
    if device.type != "cpu":
        return 5e-3 + 1e-8 * gaussians + 5e-9 * pixels + 1e-12 * weights
    threads = 0.5 + 0.5 * torch.get_num_threads()
    return 3e-3 + (8e-7 * gaussians + 3e-7 * pixels + 3e-10 * weights) / threads


def _memory_bytes(gaussians: int, sh_degree: int, trains: bool) -> int:
    """Parameters, gradients and moments, two checkpoints, and the present size of this process."""
    state = gaussians * _floats(sh_degree) * 4
    resident: int = psutil.Process().memory_info().rss
    return resident + (4 + 2 * _STATE_COPIES if trains else 3) * state


def _floats(sh_degree: int) -> int:
    """Trained numbers of a Gaussian."""
    return 11 + 3 * (sh_degree + 1) ** 2


def _file_bytes(gaussians: int, sh_degree: int, format: Format | None = None) -> int:
    """Size of a model's file: of a `.ply`, which has normals too, exactly; else about the most."""
    if format is None or format not in _PACKED:
        return 4 * gaussians * (3 + _floats(sh_degree)) + 2048
    without, harmonic = _PACKED[format]
    return round(gaussians * (without + harmonic * (_floats(sh_degree) - _floats(0)))) + 2048
