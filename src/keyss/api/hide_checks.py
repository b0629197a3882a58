"""Check that a hiding is good enough to be published."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

from keyss.api.hide_metrics import PlainModel
from keyss.core.errors import KeyssWarning, QualityError
from keyss.core.gaussians import Gaussians
from keyss.measure.hide_quality import Shown
from keyss.methods.method import Prepared

MIN_PSNR = 20.0  # dB to the plain model; below it, renders show something else
MIN_PRUNED_PSNR = 25.0  # dB, for secrets that lost Gaussians without fine-tuning
_FAR = 30.0  # dB to the plain model; differences are visible below it
_PSNR_TOLERANCE, _SSIM_TOLERANCE = 3.0, 0.1  # dB and SSIM to photos, below the plain model's
# dB. Empty renders score high for dark or small objects, and highest for invisible ones.
_BETTER_THAN_NOTHING, _GOOD, _EMPTY = 3.0, 40.0, 119.0


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
    for index, (render, model, before) in enumerate(zip(shown, models, plain, strict=True)):
        fidelity = render.fidelity
        if fidelity is None or render.plain is None:
            continue
        who = "the cover" if index == 0 else "the secret" if len(shown) == 2 else f"secret {index}"
        pruned = len(model) < before.gaussians
        kept = f" with {len(model):,} of {before.gaussians:,} Gaussians" if pruned else ""
        fact = f"{who}{kept} is at {fidelity.psnr:.1f} dB PSNR to its plain model"
        cure = '; `publish="converted"` keeps all of them, and shows that there is a secret' * (
            pruned and not prepared.survives
        )
        least = MIN_PRUNED_PSNR if pruned and not prepared.trains else MIN_PSNR
        limit = least if min_psnr is None else min_psnr
        if fidelity.psnr < limit:
            raise QualityError(
                f"{fact}, below {limit:g} dB: nothing was published; a lower `min_psnr` publishes it"
                f"{again}{cure}"
            )
        better = min(fidelity.nothing + _BETTER_THAN_NOTHING, _GOOD)
        if limit > 0 and (fidelity.psnr < better or fidelity.nothing > _EMPTY):
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
