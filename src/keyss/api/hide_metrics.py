"""The measurements of a hiding."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch

from keyss.core.gaussians import Gaussians
from keyss.fitting.image_metrics import quality
from keyss.measure.hide_quality import BaselineQuality, Shown, compare, measure_hiding
from keyss.methods.method import Prepared, Source, Stego, Training
from keyss.methods.plain_models import Bound
from keyss.runs.run_records import HideMetrics


@dataclass(frozen=True)
class PlainModel:
    """What the measurements need of a plain model."""

    gaussians: int
    sh_degree: int
    steps: int | None  # training steps; None: the model was given, unknown
    bound: Bound  # the upper bound of its scene

    @staticmethod
    def of(source: Source, training: Training, steps: int | None) -> PlainModel:
        return PlainModel(len(source.model), source.model.sh_degree, steps, Bound.of(training, steps))


def compare_with(device: torch.device, source: Source, model: Gaussians) -> Shown:
    """Compare a model with the test views of its scene, and with its plain model or renders of it."""
    plain = source.given.to(device) if source.given is not None else None
    return compare(model.to(device), plain, source.scene, of_plain=not source.photos)


def hide_metrics(
    stego: Stego,
    models: Sequence[Gaussians],  # the stego model and the revealed ones
    sources: Sequence[Source],  # these and the next: the cover, then the secrets
    shown: Sequence[Shown],
    plain: Sequence[PlainModel],
    longer: Mapping[int, Gaussians],  # the upper bounds that were fitted, by index
    prepared: Prepared,
    device: torch.device,
) -> HideMetrics:
    """The content of `metrics.json`, without the time of the run."""
    scenes, seed = [source.scene for source in sources], prepared.options.fit.known_seed
    qualities, steps = [render.plain for render in shown], [before.steps for before in plain]
    sizes, equal = [before.gaussians for before in plain], [before.bound.equal for before in plain]
    for index, model in longer.items():
        scene = scenes[index]
        qualities[index] = quality(model.to(device), scene.test, scene.background.to(device))
        sizes[index], steps[index], equal[index] = len(model), plain[index].bound.steps, True
    baseline = BaselineQuality(qualities[0], tuple(qualities[1:]), tuple(sizes), tuple(steps), tuple(equal))
    measured = measure_hiding(stego.gaussians.to(device), stego.opened, scenes, shown, baseline, seed=seed)
    return HideMetrics(
        **vars(measured),
        method=prepared.options.method,
        gaussians=len(stego.gaussians),
        photos=tuple(source.photos for source in sources),
        secret_gaussians=tuple(map(len, models[1:])),
        secret_degrees=tuple(
            (model.sh_degree, before.sh_degree) for model, before in zip(models[1:], plain[1:], strict=True)
        ),
        iterations=stego.iterations,
        steps=tuple(before.bound.steps for before in plain),
        seconds=0.0,
        width=scenes[0].train[0].camera.width,
        seed=seed,
        against_plain=tuple(render.fidelity for render in shown if render.fidelity is not None),
        details=stego.details,
    )
