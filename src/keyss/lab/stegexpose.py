"""StegExpose (2014): four detectors of LSB replacement in 8-bit images, and their mean.

An independent implementation that reproduces the original's scores, quirks included. On renders, the expected
AUC is 0.5: nothing replaces the last bits of pixels.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from keyss.core.arrays import Bytes
from keyss.core.errors import UsageError
from keyss.lab.auc import Auc, auc_between
from keyss.lab.lsb_detectors import chi_square, primary_sets, rs, sample_pairs

# In the order of the original's table.
DETECTORS = {"primary_sets": primary_sets, "chi_square": chi_square, "sample_pairs": sample_pairs, "rs": rs}


@dataclass(frozen=True)
class Scores:
    """StegExpose's scores of one image, each in [0, 1].

    A detector is NaN if its equation has no solution, and None if it does not accept the image (Sample Pairs:
    odd width or height; Chi Square: less than about 87,700 pixels). `fusion` is the mean of the available
    scores, NaN if there are none: compare only images of one size.
    """

    primary_sets: float | None
    chi_square: float | None
    sample_pairs: float | None
    rs: float | None
    fusion: float | None  # records store NaN as None


def score_image(image: Bytes) -> Scores:
    """Scores of an image [H, W, 3] uint8. Raises UsageError for another shape or type."""
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise UsageError(f"expected an image [H, W, 3] of uint8, got {list(image.shape)} of {image.dtype}")
    scores: dict[str, float | None] = {}
    for name, detector in DETECTORS.items():
        score = detector(image)
        scores[name] = score if score is None or math.isnan(score) else min(abs(score), 1.0)
    available = _finite(scores.values())
    return Scores(**scores, fusion=sum(available) / len(available) if available else math.nan)


@dataclass(frozen=True)
class StegExposeAuc:
    """StegExpose on renders of the same views by two models."""

    plain: tuple[Scores, ...]  # per view
    stego: tuple[Scores, ...]
    fused: Auc  # AUC for the mean of the detectors
    detectors: dict[str, float | None]  # AUC of each detector; None if it accepts none of the images


def stegexpose_auc(plain_images: Sequence[Bytes], stego_images: Sequence[Bytes]) -> StegExposeAuc:
    """StegExpose on renders [H, W, 3] uint8 of the same views by a plain and by a stego model.

    Chi Square needs about 87,700 pixels, Sample Pairs even sizes. Raises UsageError if the views differ in
    number or size.
    """
    sizes = [[image.shape[:2] for image in images] for images in (plain_images, stego_images)]
    if not sizes[0] or sizes[0] != sizes[1]:
        raise UsageError(
            f"expected renders of the same views, got {len(sizes[0])} and {len(sizes[1])} images"
            + (" of different sizes" if len(sizes[0]) == len(sizes[1]) > 0 else "")
        )
    plain, stego = (tuple(map(score_image, images)) for images in (plain_images, stego_images))
    detectors: dict[str, float | None] = {}
    for name in DETECTORS:
        negatives, positives = ([getattr(scores, name) for scores in group] for group in (plain, stego))
        answers = _finite(negatives + positives)
        detectors[name] = auc_between(negatives, positives).auc if answers else None
    fused = ([scores.fusion for scores in group] for group in (plain, stego))
    return StegExposeAuc(plain, stego, auc_between(*fused), detectors)


def _finite(scores: Iterable[float | None]) -> list[float]:
    """The scores that are neither None nor NaN."""
    return [score for score in scores if score is not None and not math.isnan(score)]
