"""What a run will take, before it begins: steps, room, time, memory, disk.

Sizes follow from the models and the options. Times come from constants and are rough; the progress of a run
knows better as soon as it has begun.
"""

from __future__ import annotations

import os
import resource
import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from keyss.core.errors import OutputError
from keyss.core.scene import Scene
from keyss.fitting.config import FitConfig
from keyss.fitting.ranks import here
from keyss.methods.base import Method, MethodOptions, Source, role_of
from keyss.methods.plain_models import Bound, plain_stage
from keyss.methods.plan import Plan, Stage
from keyss.progress import about

_LONG = 1000  # steps
_KEY_SECONDS = 3.0  # for each secret: deriving its key for every salt, and opening it again
_STATE_COPIES = 3  # numbers in a checkpoint for each one of a model: itself and two moments
_APPENDED = 7  # Gaussians that one of a secret of SH degree 3 becomes, at most, where they are appended
_OTHER_BYTES = 4 << 20  # records in JSON, locks, and what a file system adds


@dataclass(frozen=True)
class _Speed:
    """Seconds of a training step, forward and backward; rendering alone takes a third."""

    step: float
    gaussian: float
    pixel: float
    weight: float  # of a network

    @staticmethod
    def of(device: torch.device) -> _Speed:
        if device.type != "cpu":
            return _Speed(5e-3, 1e-8, 5e-9, 1e-12)
        threads = 0.5 + 0.5 * torch.get_num_threads()
        return _Speed(3e-3, 8e-7 / threads, 3e-7 / threads, 3e-10 / threads)

    def steps(self, gaussians: float, pixels: int, plan: Plan | None = None) -> float:
        """Seconds of a step with one view."""
        weights = 0.0
        if plan is not None:
            weights = plan.gaussian_weights * plan.gaussians + plan.pixel_weights * pixels
        return self.step + self.gaussian * gaussians + self.pixel * pixels + self.weight * weights


def plan_hiding(
    method: Method,
    options: MethodOptions,  # prepared
    sources: Sequence[Source],  # the cover, then the secrets, loaded at least with their test pictures
    device: torch.device,
    out: Path | None,
    *,
    bound: bool = False,
) -> Plan:
    """What a hiding will take. Writes nothing.

    `bound`: with plain 3DGS of as many steps as scenes have, where that is more than plain models have.
    """
    plan, speed, fit = method.plan(sources, options), _Speed.of(device), options.fit
    sizes, configs = _sizes(options, sources), options.fits(len(sources))
    roles = [role_of(index, len(sources)) for index in range(len(sources))]
    scenes = [each.scene for each in sources]
    stages = [
        _fitting(plain_stage(role), config, each.scene, size, speed)
        for role, each, config, size in zip(roles, sources, configs, sizes, strict=True)
        if each.given is None
    ]
    if plan.steps:
        drawn = sum(plan.drawn)
        views = [_pixels(scene) for scene, count in zip(scenes, plan.drawn, strict=True) if count]
        each_step = sum(speed.steps(drawn / len(views), pixels, plan) for pixels in views)
        stages.append(Stage("hiding", plan.steps, drawn, plan.steps * _views(fit) * each_step))
    for role, each, config, size, training in zip(
        roles, sources, configs, sizes, options.training(len(sources)), strict=True
    ):
        longer = Bound.of(training, config.iterations if each.given is None else None)
        if bound and each.photos and not longer.equal and longer.steps is not None:
            stages.append(_fitting(f"bound of the {role}", longer.config(fit), each.scene, size, speed))
    views_measured = 6 * sum(
        len(scene.test) * speed.steps(size, _pixels(scene)) / 3
        for scene, size in zip(scenes, sizes, strict=True)
    )
    keys = _KEY_SECONDS * len(sources[1:])
    stages.append(Stage("encrypting, opening, measuring", 0, plan.gaussians, keys + views_measured))
    trains = options.trains or any(each.given is None for each in sources)
    return replace(
        plan,
        method=method.name,
        stages=tuple(stages),
        file_bytes=_file_bytes(plan.gaussians, plan.sh_degree),
        disk_bytes=disk_bytes(options, sources),
        free_bytes=None if out is None else free_bytes(out),
        memory_bytes=_memory_bytes(plan.gaussians, plan.sh_degree, trains),
    )


def plan_fit(scene: Scene, config: FitConfig, device: torch.device) -> Plan:
    """What a plain fit will take."""
    most, degree = config.max_gaussians, config.sh_degree
    disk = 2 * _STATE_COPIES * most * _floats(degree) * 4 + _file_bytes(most, degree) + _OTHER_BYTES
    return Plan(
        gaussians=most,
        sh_degree=degree,
        asked=0,
        capacity=0,
        steps=config.iterations,
        stages=(_fitting("fit", config, scene, most, _Speed.of(device)),),
        file_bytes=_file_bytes(most, degree),
        disk_bytes=disk,
        memory_bytes=_memory_bytes(most, degree, trains=True),
    )


def worth_planning(config: FitConfig) -> bool:
    """Whether a training is so long that its estimate is worth a line."""
    return config.iterations >= _LONG


def in_a_line(plan: Plan) -> str:
    """Time, memory and disk of a run that begins."""
    return (
        f"about {about(plan.seconds)}, {plan.memory_bytes / 1e9:.1f} GB of memory, up to "
        f"{plan.disk_bytes / 1e6:,.0f} MB of disk"
    )


def _sizes(options: MethodOptions, sources: Sequence[Source]) -> list[int]:
    """Gaussians of each plain model, at most."""
    return [
        config.max_gaussians if each.given is None else len(each.given)
        for each, config in zip(sources, options.fits(len(sources)), strict=True)
    ]


def disk_bytes(options: MethodOptions, sources: Sequence[Source]) -> int:
    """The most bytes that a hiding has on disk at once: results, plain models, checkpoints being replaced."""
    sizes = _sizes(options, sources)
    degrees = [options.fit.sh_degree if each.given is None else each.given.sh_degree for each in sources]
    plain = [_file_bytes(*each) for each in zip(sizes, degrees, strict=True)]
    fitted = [size for size, each in zip(plain, sources, strict=True) if each.given is None]
    appended = _APPENDED * sum(sizes[1:]) if options.place.grows else 0
    published = _file_bytes(sizes[0] + appended, degrees[0])
    if not options.trains:
        return sum(plain) + published + 2 * _STATE_COPIES * sum(fitted) + _OTHER_BYTES
    trained = min(_file_bytes(sum(sizes), options.fit.sh_degree), sum(plain) + max(plain))
    published = max(trained, published)
    checkpoints = 2 * _STATE_COPIES * max(trained, sum(fitted)) + _STATE_COPIES * min(trained, sum(fitted))
    return sum(plain) + published + checkpoints + _OTHER_BYTES


def free_bytes(out: Path) -> int:
    """Bytes that are free where `out` is or will be."""
    folder = Path(os.path.realpath(out))
    while not folder.exists():
        folder = folder.parent
    return shutil.disk_usage(folder).free


def check_disk(out: Path, options: MethodOptions, sources: Sequence[Source]) -> None:
    """Raise OutputError unless there is room for all that a hiding writes."""
    needed, free = disk_bytes(options, sources), free_bytes(out)
    if free < needed:
        raise OutputError(
            f"{out}: expected {needed / 1e6:,.0f} MB of free space for models and checkpoints, found "
            f"{free / 1e6:,.0f} MB; make room, choose another place, or a smaller `max_gaussians`"
        )


def _fitting(name: str, config: FitConfig, scene: Scene, most: int, speed: _Speed) -> Stage:
    """A plain fit, whose Gaussians grow to the cap while it densifies."""
    mean = 0.75 * most
    seconds = config.iterations * _views(config) * speed.steps(mean, _pixels(scene))
    return Stage(name, config.iterations, most, seconds)


def _views(config: FitConfig) -> int:
    """Views of a step that this process renders."""
    return here().views(config.views_per_step) // here().count


def _memory_bytes(gaussians: int, sh_degree: int, trains: bool) -> int:
    """Parameters, gradients and moments, twice more what a checkpoint holds, and what is there already."""
    state = gaussians * _floats(sh_degree) * 4
    unit = 1 if sys.platform == "darwin" else 1024
    resident = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
    return resident + (4 + 2 * _STATE_COPIES if trains else 3) * state


def _floats(sh_degree: int) -> int:
    """Numbers of a Gaussian that are trained."""
    return 11 + 3 * (sh_degree + 1) ** 2


def _file_bytes(gaussians: int, sh_degree: int) -> int:
    """Of a PLY, which has normals too."""
    return 4 * gaussians * (3 + _floats(sh_degree)) + 2048


def _pixels(scene: Scene) -> int:
    camera = scene.test[0].camera
    return camera.width * camera.height
