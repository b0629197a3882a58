"""Check that a hiding is good enough to be published."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

from keyss.core.errors import KeyssWarning, QualityError
from keyss.measure.hide_quality import Shown
from keyss.methods.method import MethodOptions

MIN_PSNR = 20.0  # dB to the plain model; below it, renders show something else
MIN_PRUNED_PSNR = 25.0  # dB, for secrets that lost Gaussians without fine-tuning
_FAR = 30.0  # dB to the plain model; differences are visible below it
_PSNR_TOLERANCE, _SSIM_TOLERANCE = 3.0, 0.1  # dB and SSIM to photos, below the plain model's
# dB. Empty renders score high for dark or small objects, and highest for invisible ones.
_BETTER_THAN_NOTHING, _GOOD, _EMPTY = 3.0, 40.0, 119.0


def check_quality(
    shown: Sequence[Shown],
    min_psnr: float | None,
    sizes: Sequence[tuple[int, int]],
    options: MethodOptions,
    *,
    resumes: bool,
) -> None:
    """Raise QualityError if the cover or a secret is too far from its plain model; warn if it is far.

    `sizes`: Gaussians of each model and of its plain model. `resumes`: `resume` skips finished training.
    """
    again = ", and `resume=True` skips finished training" * resumes
    for index, (render, (count, before)) in enumerate(zip(shown, sizes, strict=True)):
        each, plain, own = render.fidelity, render.plain, render.quality
        if each is None or plain is None:
            continue
        who = "the cover" if index == 0 else "the secret" if len(shown) == 2 else f"secret {index}"
        cut = count < before
        least = MIN_PRUNED_PSNR if cut and not options.trains else MIN_PSNR
        limit = least if min_psnr is None else min_psnr
        kept = f" with {count:,} of {before:,} Gaussians" if cut else ""
        found = f"{who}{kept} is at {each.psnr:.1f} dB PSNR to its plain model"
        way = '; `publish="converted"` keeps all of them, and shows that there is a secret' * (
            cut and options.publish != "converted"
        )
        if each.psnr < limit:
            raise QualityError(
                f"{found}, below {limit:g} dB: nothing was published; a lower `min_psnr` publishes it"
                f"{again}{way}"
            )
        if limit > 0 and (
            each.psnr < min(each.nothing + _BETTER_THAN_NOTHING, _GOOD) or each.nothing > _EMPTY
        ):
            raise QualityError(
                f"{found}, and empty renders are at {each.nothing:.1f} dB: nothing was published; "
                f"`min_psnr=0` publishes it anyway{again}{way}"
            )
        lost = own.psnr < plain.psnr - _PSNR_TOLERANCE and each.psnr < _FAR
        if min_psnr is None and (lost or own.ssim < plain.ssim - _SSIM_TOLERANCE):
            ssims = f"SSIM {own.ssim:.2f} where the plain model has {plain.ssim:.2f}"
            warnings.warn(f"{found}, {ssims}{way}", KeyssWarning, stacklevel=3)
