"""The rough cost of a run, and a check that disk and memory have room for it."""

from __future__ import annotations

import os
import shutil
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import psutil
import torch

from keyss.core.errors import KeyssWarning, OutputError
from keyss.core.scene import Scene
from keyss.fitting.config import FitConfig
from keyss.fitting.losses import Targets
from keyss.kernels.memory import available_memory
from keyss.methods.method import MethodOptions, Plan, Prepared, Source, seconds_to_hide
from keyss.progress import about

_STEP_SECONDS = {"cpu": 5e-7, "cuda": 6e-9}  # per training step, Gaussian and two pixels
_VIEW_SECONDS = {"cpu": (1e-7, 8e-7), "cuda": (1e-8, 1e-8)}  # per measured view: by Gaussian, by pixel
_READ_SECONDS = 1.5e-6  # per Gaussian: writing a model, and reading it again
_CHECKPOINT = 3  # checkpoint / model: parameters and two moments of Adam
_MAX_APPENDED = 7  # Gaussians that hold one Gaussian of a secret of SH degree 3
_COPIES = 1  # copies in memory of the published model and the secrets, beside the given models
_SHARDS = 7  # copies of appended Gaussians: their shards, coded, placed and read again
_LONG = 60.0  # seconds; shorter work ends before its cost is read
_OTHER_BYTES = 2 << 20  # pictures, JSON files, locks


@dataclass(frozen=True)
class Cost:
    """Estimates of a run: rough times, disk space of files, and an upper limit of its memory."""

    steps: tuple[int, ...]  # training steps of the cover, then of the secrets
    seconds: float
    fit_seconds: tuple[float, ...]  # plain fits among them, the cover's first
    check_seconds: float  # reading the published file and measuring it
    view_seconds: float  # measuring the cover and the secrets on one test view each
    device: str  # "cpu" or "cuda"
    disk_bytes: int  # maximum, checkpoints included
    memory_bytes: int

    @property
    def is_long(self) -> bool:
        """Whether to announce it."""
        return self.seconds > _LONG

    def __str__(self) -> str:
        device = "the GPU" if self.device == "cuda" else "the CPU"
        return (
            f"about {about(self.seconds)} on {device}, {self.memory_bytes / 1e9:.1f} GB of memory, "
            f"up to {self.disk_bytes / 1e6:,.0f} MB of disk"
        )


def cost_of_fit(scene: Scene, fit: FitConfig, device: torch.device) -> Cost:
    """The cost of a plain fit, which is a hiding without secrets."""
    plan = Plan(gaussians=fit.max_gaussians, sh_degree=fit.sh_degree, secret_gaussians=0, capacity=0)
    prepared = Prepared.of(MethodOptions(fit=fit), 1, plan)
    return cost_of(prepared, [Source(None, photos=True, loaded=scene)], device)


def cost_of(
    prepared: Prepared,
    sources: Sequence[Source],  # the cover, then the secrets, loaded at least with their test images
    device: torch.device,
    *,
    bound: bool = False,  # also fit the upper bounds
) -> Cost:
    """The cost of a hiding."""
    fit = prepared.options.fit
    steps, sizes, saved, written = [], [], [0], [prepared.plan.gaussians]  # saved: sizes of checkpoints
    seconds, check_seconds, fit_seconds, views = 0.0, 0.0, [], []
    for source, plain, training in zip(sources, prepared.fits, prepared.training, strict=True):
        known = source.given if training.continues else None
        size = fit.max_gaussians if known is None else len(known)
        plain_steps = plain.iterations if source.given is None else 0
        renders = plain_steps + training.steps * training.step_cost
        if bound and source.photos and not training.keeps_bound(plain_steps or None):
            renders += training.total(plain_steps or None) or 0
            saved.append(size)
            written.append(size)
        step = _STEP_SECONDS[device.type] * (size + _pixels(source.scene) / 2)
        seconds += renders * step
        views.append(view_seconds(device.type, size, source.scene))
        check_seconds += len(source.scene.test) * views[-1] + _READ_SECONDS * size
        fit_seconds.append(plain_steps * step)
        steps.append(plain_steps + training.steps)
        saved += [size] * (plain_steps > 0)
        if training.steps and training.continues:
            saved.append(min(size, prepared.plan.capacity))
        written += [size] * source.photos
        sizes.append(size)
    if any(training.steps and not training.continues for training in prepared.training):
        saved.append(fit.max_gaussians)  # the joint training
    seconds += seconds_to_hide(sizes[0], sizes[1:], prepared.grows) + check_seconds
    appended = _MAX_APPENDED * sum(sizes[1:]) if prepared.grows else 0
    published = sizes[0] + appended
    degree = max(fit.sh_degree if source.given is None else source.given.sh_degree for source in sources)
    gaussian = 4 * (14 + 3 * (degree + 1) ** 2)  # bytes in a .ply, with normals
    resident: int = psutil.Process().memory_info().rss
    memory = resident + (_COPIES * (published + sum(sizes[1:])) + _SHARDS * appended) * gaussian
    if any(saved):  # gradients, moments and two checkpoints
        memory += (1 + 2 * _CHECKPOINT) * max(published, *sizes) * gaussian
        memory += max(Targets.max_bytes(source.scene.train) for source in sources)
    # Checkpoints stay until the results are written; a new one is written before the old one is removed.
    stored = _CHECKPOINT * sum(saved) + max(_CHECKPOINT * max(saved), sum(written))
    disk = stored * gaussian + _OTHER_BYTES
    times = seconds, tuple(fit_seconds), check_seconds, sum(views)
    return Cost(tuple(steps), *times, device.type, disk, memory)


def view_seconds(device: str, gaussians: int, scene: Scene) -> float:
    """About the seconds to measure a model, and its plain model, on one test view of a scene."""
    per_gaussian, per_pixel = _VIEW_SECONDS[device]
    return per_gaussian * gaussians + per_pixel * _pixels(scene)


def _pixels(scene: Scene) -> int:
    camera = scene.test[0].camera
    return camera.width * camera.height


def check_room(cost: Cost, out: Path | None) -> None:
    """Raise OutputError if the disk of `out` lacks space for all files; warn if memory is short."""
    if out is not None:
        real = Path(os.path.realpath(out))  # need not exist
        free = shutil.disk_usage(next(folder for folder in (real, *real.parents) if folder.exists())).free
        if free < cost.disk_bytes:
            raise OutputError(
                f"{out}: expected {cost.disk_bytes / 1e6:,.0f} MB of free space for models and checkpoints, "
                f"found {free / 1e6:,.0f} MB; make room, choose another place, or a smaller `max_gaussians`"
            )
    if cost.memory_bytes > (available := available_memory()):
        warnings.warn(
            f"this takes about {cost.memory_bytes / 1e9:.1f} GB of memory, and {available / 1e9:.1f} GB are "
            "free: a smaller `width` or `max_gaussians` takes less",
            KeyssWarning,
            stacklevel=2,
        )
