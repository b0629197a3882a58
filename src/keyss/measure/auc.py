"""How well a score separates two classes: the area under the ROC curve, and StegExpose's on renders."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from keyss.core import UsageError
from keyss.measure.stegexpose import DETECTORS, Scores, score_image

_Z = 1.959963984540054  # standard normal quantile of 0.975

Score = float | None
Image = NDArray[np.uint8]  # [H, W, 3]
Doubles = NDArray[np.float64]


@dataclass(frozen=True)
class Auc:
    """The area under a ROC curve: how often a positive scores above a negative, ties counting half."""

    auc: float  # in [0, 1]
    low: float  # 95 % interval, by DeLong (1988)
    high: float


@dataclass(frozen=True)
class StegExposeAuc:
    """StegExpose on renders of the same views by two models."""

    plain: tuple[Scores, ...]  # of each view
    stego: tuple[Scores, ...]
    fused: Auc  # of the mean of the detectors
    detectors: dict[str, float | None]  # AUC of each detector; None if it accepts none of the images


def auc_between(negatives: Sequence[Score], positives: Sequence[Score]) -> Auc:
    """The AUC of scores that should be higher for positives; None and NaN are missing scores.

    A missing score counts as lower than every number, so a detector that answers less often for one class can
    have an AUC far from 0.5. The interval treats images as independent, which neighbouring views are not: it
    is too narrow. Raises UsageError for an empty class.
    """
    if not negatives or not positives:
        raise UsageError(f"expected scores of both classes, got {len(negatives)} and {len(positives)}")
    plain, stego = (
        np.array([-math.inf if _is_missing(each) else each for each in scores], dtype=float)
        for scores in (negatives, positives)
    )
    auc, variance = delong(plain, stego)
    return Auc(auc, *_interval(auc, variance, min(len(plain), len(stego))))


def delong(negatives: Doubles, positives: Doubles) -> tuple[float, float]:
    """AUC of scores [N] and [P], and its variance by DeLong, DeLong and Clarke-Pearson.

    By ranks, as in Sun and Xu (2014). The variance is 0 if a class has a single score.
    """
    from scipy.stats import rankdata  # slow to import

    n, p = len(negatives), len(positives)
    ranks = rankdata(np.concatenate([negatives, positives]))
    below = (ranks[n:] - rankdata(positives)) / n  # the share of negatives below each positive
    above = 1 - (ranks[:n] - rankdata(negatives)) / p
    variance = float(below.var(ddof=1) / p + above.var(ddof=1) / n) if min(n, p) > 1 else 0.0
    return float(below.mean()), variance


def stegexpose_auc(plain_images: Sequence[Image], stego_images: Sequence[Image]) -> StegExposeAuc:
    """StegExpose on renders of the same views by a plain and by a stego model, [H, W, 3] uint8 each.

    Chi Square needs about 87,700 pixels, Sample Pairs even sizes. On a renderer's output an AUC near 0.5 is
    expected whatever is hidden, since no pixel's last bit is replaced. Raises UsageError if the views differ
    in number or size.
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
        negatives, positives = ([asdict(scores)[name] for scores in each] for each in (plain, stego))
        silent = all(map(_is_missing, negatives + positives))
        detectors[name] = None if silent else auc_between(negatives, positives).auc
    fused = ([scores.fusion for scores in each] for each in (plain, stego))
    return StegExposeAuc(plain, stego, auc_between(*fused), detectors)


def _interval(auc: float, variance: float, pairs: int) -> tuple[float, float]:
    """By DeLong's variance on the logit scale (Pepe 2003).

    There is no variance if a class is a single image or the classes do not overlap. Disjoint pairs, one image
    of each class, are independent trials then: k of k in order leave 0.025^(1/k) possible.
    """
    from scipy.special import expit, logit

    if variance == 0:
        slack = 1 - 0.025 ** (1 / pairs)
        return max(0.0, auc - slack), min(1.0, auc + slack)
    spread = _Z * math.sqrt(variance) / (auc * (1 - auc))
    return float(expit(logit(auc) - spread)), float(expit(logit(auc) + spread))


def _is_missing(score: Score) -> bool:
    return score is None or math.isnan(score)
