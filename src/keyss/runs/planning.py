"""Plans of runs: capacity, disk and memory follow from models and options; times are rough."""

from __future__ import annotations

import os
import shutil
import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import psutil
import torch

from keyss.core.errors import KeyssWarning, OutputError
from keyss.core.scene import Scene
from keyss.fitting.config import FitConfig
from keyss.fitting.losses import Targets
from keyss.methods.base import Method, MethodOptions, Plan, Source
from keyss.methods.plain_models import Bound
from keyss.progress import about

_STEP_SECONDS = {"cpu": 5e-7, "cuda": 6e-9}  # per training step, Gaussian and two pixels
_KEY_SECONDS = 3.0  # deriving a secret's key for every salt, and opening the secret again
_RENDERS = 2  # training steps that take as long as measuring a test view
_STATE_COPIES = 3  # checkpoint / model: parameters and two moments of Adam
_MAX_APPENDED = 7  # Gaussians that hold one Gaussian of a secret of SH degree 3
_OTHER_BYTES = 4 << 20  # JSON files, locks, and the overhead of the file system


class Needs(NamedTuple):
    """Upper limits of a run's disk space and memory."""

    disk_bytes: int
    memory_bytes: int


def plan_hiding(
    method: Method,
    options: MethodOptions,  # prepared
    sources: Sequence[Source],  # the cover, then the secrets, loaded at least with their test images
    device: torch.device,
    *,
    bound: bool = False,  # also fit the upper bounds
) -> Plan:
    """The plan of a hiding. Writes nothing."""
    plan, count = method.plan(sources, options), len(sources)
    steps, seconds, fits = plan.steps, _KEY_SECONDS * (count - 1), []
    rendered = plan.rendered or (0,) * count
    for source, size, joint, config, training in zip(
        sources, _sizes(options, sources), rendered, options.fits(count), options.training(count), strict=True
    ):
        step = _view_seconds(device, size, source.scene)
        own = config.iterations if source.given is None else 0
        steps += own
        fits.append(own * step)
        seconds += _RENDERS * len(source.scene.test) * step
        if joint:
            seconds += plan.steps * plan.step_cost * _view_seconds(device, joint, source.scene)
        longer = Bound.of(training, own or None)
        if bound and source.photos and not longer.equal:
            seconds += (longer.steps or 0) * step
    needs = needs_of_hiding(options, sources)
    return replace(
        plan,
        method=method.name,
        steps=steps,
        fit_seconds=tuple(fits),
        other_seconds=seconds,
        file_bytes=_ply_bytes(plan.gaussians, plan.sh_degree),
        disk_bytes=needs.disk_bytes,
        memory_bytes=needs.memory_bytes,
    )


def plan_fit(scene: Scene, config: FitConfig, device: torch.device) -> Plan:
    """The plan of a plain fit."""
    gaussians, degree, needs = config.max_gaussians, config.sh_degree, needs_of_fit(scene, config)
    step = _view_seconds(device, gaussians, scene)
    return Plan(
        gaussians=gaussians,
        sh_degree=degree,
        secret_gaussians=0,
        capacity=0,
        steps=config.iterations,
        fit_seconds=(config.iterations * step,),
        file_bytes=_ply_bytes(gaussians, degree),
        disk_bytes=needs.disk_bytes,
        memory_bytes=needs.memory_bytes,
    )


def needs_of_hiding(options: MethodOptions, sources: Sequence[Source]) -> Needs:
    """Needs of a hiding; `options` are prepared."""
    sizes, fit = _sizes(options, sources), options.fit
    degree = max(fit.sh_degree if source.given is None else source.given.sh_degree for source in sources)
    fitted = [options.trains or source.given is None for source in sources]
    trained = sum(size for size, each in zip(sizes, fitted, strict=True) if each)
    appended = _MAX_APPENDED * sum(sizes[1:]) if options.place.grows else 0
    published = max(sizes[0], fit.max_gaussians if options.trains else 0) + appended
    photos = [source.scene for source in sources if trained]
    return _needs(published, published + sum(sizes), trained, degree, photos)


def needs_of_fit(scene: Scene, config: FitConfig) -> Needs:
    """Needs of a plain fit."""
    cap = config.max_gaussians
    return _needs(cap, cap, cap, config.sh_degree, [scene])


def _needs(largest: int, written: int, trained: int, degree: int, photos: Sequence[Scene]) -> Needs:
    """Needs from numbers of Gaussians. Training has gradients, moments and two checkpoints."""
    resident: int = psutil.Process().memory_info().rss
    copies = 4 + 2 * _STATE_COPIES if trained else 3
    targets = max((Targets.max_bytes(scene.train) for scene in photos), default=0)
    return Needs(
        _ply_bytes(written + 2 * _STATE_COPIES * trained, degree) + _OTHER_BYTES,
        resident + copies * _ply_bytes(largest, degree) + targets,
    )


def in_a_line(plan: Plan) -> str:
    """Size of the published file, time, memory and disk of a run."""
    return (
        f"a file of up to {plan.file_bytes / 1e6:,.1f} MB, about {about(plan.seconds)}, "
        f"{plan.memory_bytes / 1e9:.1f} GB of memory, up to {plan.disk_bytes / 1e6:,.0f} MB of disk"
    )


def check_room(needs: Needs, out: Path | None) -> None:
    """Raise OutputError if the disk of `out` lacks space for all files; warn if memory is short."""
    if out is not None and (free := _free_bytes(out)) < needs.disk_bytes:
        raise OutputError(
            f"{out}: expected {needs.disk_bytes / 1e6:,.0f} MB of free space for models and checkpoints, "
            f"found {free / 1e6:,.0f} MB; make room, choose another place, or a smaller `max_gaussians`"
        )
    if needs.memory_bytes > (available := _available_memory()):
        warnings.warn(
            f"this takes about {needs.memory_bytes / 1e9:.1f} GB of memory, and {available / 1e9:.1f} GB are "
            "free: a smaller `width` or `max_gaussians` takes less",
            KeyssWarning,
            stacklevel=2,
        )


def _available_memory() -> int:
    """Bytes available on the machine and in its container (Linux, cgroup 2)."""
    available: int = psutil.virtual_memory().available
    with suppress(OSError, ValueError, KeyError):  # "max" without a limit
        group = Path("/sys/fs/cgroup")
        limit, used = (int((group / f"memory.{name}").read_text()) for name in ("max", "current"))
        cached = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
        available = min(available, limit - used + int(cached["inactive_file"]))
    return available


def _sizes(options: MethodOptions, sources: Sequence[Source]) -> list[int]:
    """Upper limits of the Gaussians of the plain models."""
    return [
        config.max_gaussians if source.given is None else len(source.given)
        for source, config in zip(sources, options.fits(len(sources)), strict=True)
    ]


def _free_bytes(out: Path) -> int:
    """Free bytes on the disk of `out`, which need not exist."""
    folder = Path(os.path.realpath(out))
    while not folder.exists():
        folder = folder.parent
    return shutil.disk_usage(folder).free


def _view_seconds(device: torch.device, gaussians: int, scene: Scene) -> float:
    """Seconds of a training step with one view."""
    camera = scene.test[0].camera
    return _STEP_SECONDS[device.type] * (gaussians + camera.width * camera.height / 2)


def _ply_bytes(gaussians: int, sh_degree: int) -> int:
    """Size of a model as .ply, with normals; other formats take less."""
    return 4 * gaussians * (14 + 3 * (sh_degree + 1) ** 2) + 2048
