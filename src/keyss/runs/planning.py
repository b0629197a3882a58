"""What a hiding will take, before it begins: steps, room, time, memory, disk.

Sizes follow from the models and the options. Times are those of a few steps at the sizes to come, on this
machine and while it does what else it does, extrapolated: rough, mostly within a factor of two.
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
from keyss.fitting.side_by_side import SIDE_BY_SIDE, Fit, at_once, process_bytes
from keyss.methods.base import Method, MethodOptions, Outlook, SceneInput, role_of
from keyss.methods.plain_models import Bound, plain_stage
from keyss.progress import about
from keyss.rendering.orbit import TEST_EVERY, VIEWS
from keyss.runs.probing import Probe, decoding_seconds

_LONG = 1000  # steps
_WATCHED = 8  # views that a training looks at every `evaluate_every` steps
_KEY_SECONDS = 3.0  # for each secret: deriving its key for every salt, and opening it again
_CODING_SECONDS = 2e-5  # for each Gaussian of the published model: finding carriers, encrypting, writing
_STATE_COPIES = 3  # numbers that a checkpoint has for one of a model: itself and two moments
_APPENDED = 7  # Gaussians that one of a secret of SH degree 3 becomes, at most, where they are appended
_OTHER_BYTES = 4 << 20  # records in JSON, locks, and what a file system adds


@dataclass(frozen=True)
class Stage:
    """A part of a run."""

    name: str
    steps: int  # 0 where nothing is trained
    gaussians: int  # at its end, at most
    seconds: float


@dataclass(frozen=True)
class Plan:
    """A whole run. Times, memory and disk are estimates."""

    method: str
    stages: tuple[Stage, ...]
    outlook: Outlook
    file_bytes: int  # of the published model, at most
    disk_bytes: int  # of all files that are there at the same time, checkpoints included
    free_bytes: int | None  # where they are to be written, None without such a place
    memory_bytes: int

    @property
    def seconds(self) -> float:
        return sum(stage.seconds for stage in self.stages)

    def __str__(self) -> str:
        """In one line, what a person wants to know before the run begins."""
        return _line(self.seconds, self.memory_bytes, self.disk_bytes)


@dataclass(frozen=True)
class PlannedRun:
    """One of several runs that are asked for."""

    name: str
    done: bool
    seconds: float = 0.0  # that it takes, roughly; 0 for one that is done
    error: str | None = None  # why it is not possible


def plan_hiding(
    method: Method,
    options: MethodOptions,  # prepared
    inputs: Sequence[SceneInput],  # of the cover, then of the secrets
    scenes: Sequence[Scene],  # of these, at least with their test pictures
    device: torch.device,
    out: Path | None,
    *,
    bound: bool = False,
) -> Plan:
    """What hiding `scenes` comes to, after a few steps of training at the sizes to come. Writes nothing.

    `bound`: with plain 3DGS of as many steps as scenes have, where that is more than plain models have.
    """
    outlook = method.outlook(inputs, options)
    fits = [each.model is None for each in inputs]
    trains = method.trains or any(fits)
    probes = [
        Probe(scene, each.model, options.fit, outlook.sh_degree, device, trains)
        for scene, each in zip(scenes, inputs, strict=True)
    ]
    # As the method itself makes pictures: by way of networks, where it has some.
    networks = outlook.networks or (None,) * len(inputs)
    shown = [
        probe if network is None else probe.through(network)
        for probe, network in zip(probes, networks, strict=True)
    ]
    sizes = [options.fit.max_gaussians if each.model is None else len(each.model) for each in inputs]
    stages, plain, bounds = list[Stage](), list[Fit](), list[Fit]()
    for index, (probe, each) in enumerate(zip(probes, inputs, strict=True)):
        role = role_of(index, len(inputs))
        if not each.photos:
            views = VIEWS if trains else VIEWS // TEST_EVERY
            stages.append(
                Stage(f"pictures of the {role}", 0, sizes[index], views * probe.picture(sizes[index]))
            )
        if each.model is None:
            plain.append(Fit(scenes[index], options.fit, plain_stage(role)))
            stages.append(_fitting(plain[-1].title, options.fit, probe, sizes[index]))
    if method.trains:
        decoding = 0.0
        if outlook.decode is not None:
            of_scene = (scenes[0], outlook.gaussians, options.fit, device)
            decoding = outlook.decodings * decoding_seconds(outlook.decode, *of_scene)
        stages.append(_hiding(options.fit, shown, outlook, decoding))
    for index, (probe, each, training) in enumerate(
        zip(probes, inputs, options.training(len(inputs)), strict=True)
    ):
        longer = Bound.of(training, options.fit.iterations if each.model is None else None)
        if bound and each.photos and not longer.equal and longer.steps is not None:
            name, config = f"bound of the {role_of(index, len(inputs))}", longer.config(options.fit)
            bounds.append(Fit(scenes[index], config, name))
            stages.append(_fitting(name, config, probe, sizes[index]))
    stages, processes = _side_by_side(stages, (plain, bounds), device)
    writing = _KEY_SECONDS * len(inputs[1:]) + _CODING_SECONDS * outlook.gaussians
    stages.append(Stage("encrypting, opening again", 0, outlook.gaussians, writing))
    stages.append(
        Stage("measuring", 0, outlook.gaussians, _measuring(method, probes, shown, scenes, sizes, outlook))
    )

    state = outlook.gaussians * _floats(outlook.sh_degree) * 4
    pictures = sum(
        (VIEWS - VIEWS // TEST_EVERY) * _pixels(scene) * 3
        for scene, each in zip(scenes, inputs, strict=True)
        if not each.photos and trains
    )
    # Parameters, gradients and moments, twice more all that a checkpoint holds while it is written.
    trained = state * (4 + 2 * _STATE_COPIES) if trains else 3 * state
    memory = _resident_bytes() + pictures + max(trained, processes)
    return Plan(
        method=method.name,
        stages=tuple(stages),
        outlook=outlook,
        file_bytes=_file_bytes(outlook.gaussians, outlook.sh_degree),
        disk_bytes=disk_bytes(method, options, inputs),
        free_bytes=None if out is None else free_bytes(out),
        memory_bytes=memory,
    )


def plan_fit(scene: Scene, config: FitConfig, device: torch.device) -> str:
    """What a plain fit will take, in one line."""
    most = config.max_gaussians
    stage = _fitting("fit", config, Probe(scene, None, config, config.sh_degree, device, True), most)
    state = most * _floats(config.sh_degree) * 4
    disk = 2 * _STATE_COPIES * state + _file_bytes(most, config.sh_degree) + _OTHER_BYTES
    return _line(stage.seconds, _resident_bytes() + state * (4 + 2 * _STATE_COPIES), disk)


def worth_planning(config: FitConfig) -> bool:
    """Whether a training takes so much longer than to plan it that a person wants to know."""
    return config.iterations >= _LONG


def _line(seconds: float, memory: int, disk: int) -> str:
    return (
        f"about {about(seconds)} on this machine as busy as it is, {memory / 1e9:.1f} GB of memory, up to "
        f"{disk / 1e6:,.0f} MB of disk"
    )


def disk_bytes(method: Method, options: MethodOptions, inputs: Sequence[SceneInput]) -> int:
    """The most bytes that a hiding has on disk at once: results, plain models, checkpoints being replaced."""
    sizes = [options.fit.max_gaussians if each.model is None else len(each.model) for each in inputs]
    degrees = [options.fit.sh_degree if each.model is None else each.model.sh_degree for each in inputs]
    plain = [_file_bytes(*each) for each in zip(sizes, degrees, strict=True)]
    fitted = [size for size, each in zip(plain, inputs, strict=True) if each.model is None]
    appends = options.publish == "any" and options.channel == "appended"
    published = _file_bytes(sizes[0] + _APPENDED * sum(sizes[1:]), degrees[0]) if appends else plain[0]
    if not method.trains:
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


def check_disk(out: Path, method: Method, options: MethodOptions, inputs: Sequence[SceneInput]) -> None:
    """Raise OutputError unless there is room for all that a hiding writes."""
    needed, free = disk_bytes(method, options, inputs), free_bytes(out)
    if free < needed:
        raise OutputError(
            f"{out}: expected {needed / 1e6:,.0f} MB of free space for models and checkpoints, found "
            f"{free / 1e6:,.0f} MB; make room, choose another place, or a smaller `max_gaussians`"
        )


def _fitting(name: str, config: FitConfig, probe: Probe, most: int) -> Stage:
    """A plain fit: as many Gaussians as points at first, growing to the cap while it densifies."""
    grows, grown = config.grow_start, 0.5 * (config.grow_start + config.grow_stop)
    first, last = probe.step(probe.start), probe.step(most)
    each = grows * first + (grown - grows) * 0.5 * (first + last) + (1 - grown) * last
    seconds = config.iterations * _views(config) * each + _watching(config, [probe], [most])
    return Stage(name, config.iterations, most, seconds)


def _side_by_side(
    stages: Sequence[Stage], groups: Sequence[Sequence[Fit]], device: torch.device
) -> tuple[list[Stage], int]:
    """The stages where fits of a group are done at the same time; bytes that their processes take."""
    factors, most = dict[str, float](), 0
    for fits in groups:
        if (count := at_once(fits, device)) > 1:
            factors |= {fit.title: SIDE_BY_SIDE for fit in fits}
            most = max(most, sum(sorted(map(process_bytes, fits))[-count:]))
    return [replace(each, seconds=each.seconds * factors.get(each.name, 1.0)) for each in stages], most


def _hiding(config: FitConfig, probes: Sequence[Probe], outlook: Outlook, decoding: float) -> Stage:
    """The method's own training: a picture of every scene that it draws, and `decoding` seconds, a step."""
    drawn = [(probe, count) for probe, count in zip(probes, outlook.drawn, strict=True) if count]
    each = _views(config) * (decoding + sum(probe.step(count) for probe, count in drawn))
    watching = _watching(config, [probe for probe, _ in drawn], [count for _, count in drawn], outlook.steps)
    return Stage("hiding", outlook.steps, sum(outlook.drawn), outlook.steps * each + watching)


def _views(config: FitConfig) -> int:
    """Views of a step that this process draws."""
    return here().views(config.views_per_step) // here().count


def _watching(
    config: FitConfig, probes: Sequence[Probe], sizes: Sequence[float], steps: int | None = None
) -> float:
    """Seconds of looking at held-out views during a training."""
    if not config.evaluate_every:
        return 0.0
    times = (config.iterations if steps is None else steps) // config.evaluate_every
    views = (min(_WATCHED, len(probe.scene.test)) for probe in probes)
    return times * sum(
        count * probe.picture(size) for count, probe, size in zip(views, probes, sizes, strict=True)
    )


def _measuring(
    method: Method,
    probes: Sequence[Probe],
    shown: Sequence[Probe],
    scenes: Sequence[Scene],
    sizes: Sequence[int],
    outlook: Outlook,
) -> float:
    """Seconds for all pictures of the results: of each scene its own, the plain model's, and wrong keys'."""
    share = min(1.0, outlook.gaussians / sum(sizes)) if method.trains else 1.0
    plain, own = (
        [
            len(scene.test) * probe.picture(share * size)
            for probe, scene, size in zip(each, scenes, sizes, strict=True)
        ]
        for each in (probes, shown)
    )
    wrong = 32 if method.trains else 0  # keys, seen from the cameras of the cover and of the secret
    wrong *= method.capabilities.keys
    decoding = sum(own[:1]) * len(own[1:]) + sum(own[1:])
    return 3 * sum(plain) + 3 * sum(own) + wrong * decoding


def _floats(sh_degree: int) -> int:
    """Numbers of a Gaussian that are trained."""
    return 11 + 3 * (sh_degree + 1) ** 2


def _file_bytes(gaussians: int, sh_degree: int) -> int:
    """Of a PLY, which has normals too."""
    return 4 * gaussians * (3 + _floats(sh_degree)) + 2048


def _pixels(scene: Scene) -> int:
    camera = scene.test[0].camera
    return camera.width * camera.height


def _resident_bytes() -> int:
    """The most memory that this process has had."""
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
