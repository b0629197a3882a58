"""StegExpose (2014): four detectors of LSB replacement in 8-bit images, and their mean.

An independent implementation that reproduces the original's scores, quirks included. On renders, the expected
AUC is 0.5: nothing replaces the last bits of pixels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from keyss.core.arrays import Bytes
from keyss.core.errors import UsageError
from keyss.lab.auc import Auc, auc_between
from keyss.lab.lsb_detectors import chi_square, primary_sets, rs, sample_pairs

# In the order of the original's table.
DETECTORS = {"primary_sets": primary_sets, "chi_square": chi_square, "sample_pairs": sample_pairs, "rs": rs}


def score_image(image: Bytes) -> dict[str, float | None]:
    """Scores of an image [H, W, 3] uint8 by detector, and their mean `fusion`; each in [0, 1].

    A detector is NaN if its equation has no solution, and None if it does not accept the image (Sample Pairs:
    odd width or height; Chi Square: less than about 87,700 pixels). `fusion` is the mean of the available
    scores, NaN if there are none: compare only images of one size. Raises UsageError for another shape or
    type.
    """
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise UsageError(f"expected an image [H, W, 3] of uint8, got {list(image.shape)} of {image.dtype}")
    scores: dict[str, float | None] = {}
    for name, detector in DETECTORS.items():
        score = detector(image)
        scores[name] = score if score is None or math.isnan(score) else min(abs(score), 1.0)
    available = [score for score in scores.values() if score is not None and not math.isnan(score)]
    return scores | {"fusion": sum(available) / len(available) if available else math.nan}


def stegexpose_auc(plain_images: Sequence[Bytes], stego_images: Sequence[Bytes]) -> Auc:
    """AUC of the mean of the detectors between renders [H, W, 3] uint8 of the same views by two models.

    Chi Square needs about 87,700 pixels, Sample Pairs even sizes.
    """
    plain, stego = (
        [score_image(image)["fusion"] for image in images] for images in (plain_images, stego_images)
    )
    return auc_between(plain, stego)
