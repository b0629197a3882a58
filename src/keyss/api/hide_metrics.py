"""The measurements of a hiding, and a check that it is good enough to be published."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch

from keyss.core.errors import KeyssWarning, QualityError
from keyss.core.gaussians import Gaussians
from keyss.fitting.image_metrics import quality
from keyss.measure.hide_quality import BaselineQuality, Shown, measure_without_keys
from keyss.methods.method import Prepared, Source, Stego, Training
from keyss.runs.run_records import HideMetrics

_MIN_PSNR = 20.0  # dB to the plain model; below it, renders show something else
_MIN_PRUNED_PSNR = 25.0  # dB, for secrets that lost Gaussians without fine-tuning
_FAR = 30.0  # dB to the plain model; differences are visible below it
_PSNR_TOLERANCE, _SSIM_TOLERANCE = 3.0, 0.1  # dB and SSIM to photos, below the plain model's
# dB. Empty renders score high for dark or small objects, and highest for invisible ones.
_BETTER_THAN_NOTHING, _GOOD, _EMPTY = 3.0, 40.0, 119.0


@dataclass(frozen=True)
class PlainModel:
    """What the measurements need of a plain model."""

    gaussians: int
    sh_degree: int
    steps: int | None  # training steps; None: the model was given, unknown
    total_steps: int | None  # with those of the method
    is_bound: bool  # whether it is the upper bound

    @staticmethod
    def of(source: Source, training: Training) -> PlainModel:
        size = len(source.model), source.model.sh_degree
        return PlainModel(
            *size, source.steps, training.total(source.steps), training.keeps_bound(source.steps)
        )


def check_quality(
    shown: Sequence[Shown],
    min_psnr: float | None,
    models: Sequence[Gaussians],
    plain: Sequence[PlainModel],
    prepared: Prepared,
    *,
    resumes: bool,
) -> None:
    """Raise QualityError if the cover or a secret is too far from its plain model; warn if it is far.

    `models`: the stego model and the revealed ones. `resumes`: `resume` skips finished training.
    """
    again = ", and `resume=True` skips finished training" * resumes
    joint = bool(prepared.training[0].steps)  # training cover and secrets together prunes none for capacity
    for index, (render, model, before) in enumerate(zip(shown, models, plain, strict=True)):
        fidelity = render.fidelity
        if fidelity is None or render.plain is None:
            continue
        who = "the cover" if index == 0 else "the secret" if len(shown) == 2 else f"secret {index}"
        pruned = not joint and len(model) < before.gaussians
        kept = f" with {len(model):,} of {before.gaussians:,} Gaussians" if pruned else ""
        fact = f"{who}{kept} is at {fidelity.psnr:.2f} dB PSNR to its plain model (mean error of test views)"
        cure = "; more training steps (`iterations`) bring it nearer" * joint
        if pruned and not prepared.survives:
            cure = '; `publish="converted"` keeps all of them, and shows that there is a secret'
        least = _MIN_PRUNED_PSNR if pruned and not prepared.trains else _MIN_PSNR
        limit = least if min_psnr is None else min_psnr
        better = min(fidelity.nothing + _BETTER_THAN_NOTHING, _GOOD)
        is_empty = fidelity.psnr < better or fidelity.nothing > _EMPTY
        if fidelity.psnr < limit and not is_empty:
            raise QualityError(
                f"{fact}, below {limit:g} dB: nothing was published; a lower `min_psnr` publishes it"
                f"{again}{cure}"
            )
        if limit > 0 and is_empty:
            raise QualityError(
                f"{fact}, and empty renders are at {fidelity.nothing:.1f} dB: nothing was published; "
                f"`min_psnr=0` publishes it anyway{again}{cure}"
            )
        psnr_lost = render.plain.psnr - render.quality.psnr
        ssim, plain_ssim = render.quality.ssim, render.plain.ssim
        if min_psnr is None and (
            (psnr_lost > _PSNR_TOLERANCE and fidelity.psnr < _FAR) or ssim < plain_ssim - _SSIM_TOLERANCE
        ):
            ssims = f"SSIM {ssim:.2f} where the plain model has {plain_ssim:.2f}"
            warnings.warn(f"{fact}, {ssims}{cure}", KeyssWarning, stacklevel=3)


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
    sizes, equal = [before.gaussians for before in plain], [before.is_bound for before in plain]
    for index, model in longer.items():
        scene = scenes[index]
        qualities[index] = quality(model.to(device), scene.test, scene.background.to(device))
        sizes[index], steps[index], equal[index] = len(model), plain[index].total_steps, True
    baseline = BaselineQuality(qualities[0], tuple(qualities[1:]), tuple(sizes), tuple(steps), tuple(equal))
    wrong, chance = measure_without_keys(stego.gaussians.to(device), stego.opened, scenes, seed=seed)
    return HideMetrics(
        method=prepared.options.method,
        cover=shown[0].quality,
        secrets=tuple(render.quality for render in shown[1:]),
        baseline=baseline,
        wrong_key=wrong,
        chance_level=chance,
        gaussians=len(stego.gaussians),
        photos=tuple(source.photos for source in sources),
        secret_gaussians=tuple(map(len, models[1:])),
        secret_degrees=tuple(
            (model.sh_degree, before.sh_degree) for model, before in zip(models[1:], plain[1:], strict=True)
        ),
        iterations=stego.iterations,
        steps=tuple(before.total_steps for before in plain),
        seconds=0.0,
        width=scenes[0].train[0].camera.width,
        seed=seed,
        against_plain=tuple(render.fidelity for render in shown if render.fidelity is not None),
        details=stego.details,
    )
