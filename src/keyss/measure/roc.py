"""How well a score tells stego from plain: ROC curves, and StegExpose's on renders of the same views."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logit

from keyss.core.errors import UsageError
from keyss.measure.stegexpose import DETECTORS, Scores, score_image

_Z = 1.959963984540054  # standard normal quantile of 0.975

Score = float | None
Image = NDArray[np.uint8]  # [H, W, 3]
Doubles = NDArray[np.float64]


@dataclass(frozen=True)
class Roc:
    """The receiver operating characteristic of a score that should be higher for positives."""

    auc: float  # in [0, 1]: how often a positive scores above a negative, ties counting half
    low: float  # 95 % interval
    high: float
    fpr: tuple[float, ...]  # corners of the curve, from (0, 0) to (1, 1)
    tpr: tuple[float, ...]
    unanswered: tuple[int, int]  # negatives and positives without a score
    interval: str = "DeLong 1988, on the logit scale, 95 %"


@dataclass(frozen=True)
class StegExposeRoc:
    """StegExpose on renders of the same views by two models."""

    plain: tuple[Scores, ...]  # of each view
    stego: tuple[Scores, ...]
    roc: Roc  # of the fused scores
    detectors: dict[str, float | None]  # AUC of each alone, None where it takes no image


def roc(negatives: Sequence[Score], positives: Sequence[Score]) -> Roc:
    """The ROC of scores, NaN or None where there is none.

    What is missing is above no threshold, so it counts as lower than every number; a detector that answers
    one class less often can so have an AUC far from 0.5. The interval takes all images for independent, which
    renders of neighbouring views are not: a small one means less than it seems. Raises UsageError where a
    class is empty.
    """
    from sklearn.metrics import roc_curve  # slow to import

    if not negatives or not positives:
        raise UsageError(f"expected scores of both classes, got {len(negatives)} and {len(positives)}")
    from scipy.stats import rankdata  # takes a third of a second to load

    ranks = rankdata([-math.inf if _is_missing(each) else each for each in (*negatives, *positives)])
    plain, stego = ranks[: len(negatives)], ranks[len(negatives) :]
    fpr, tpr, _ = roc_curve(np.repeat([0, 1], [len(plain), len(stego)]), ranks)
    auc, variance = delong(plain, stego)
    return Roc(
        auc,
        *_interval(auc, variance, min(len(plain), len(stego))),
        tuple(fpr.tolist()),
        tuple(tpr.tolist()),
        (sum(map(_is_missing, negatives)), sum(map(_is_missing, positives))),
    )


def delong(negatives: Doubles, positives: Doubles) -> tuple[float, float]:
    """AUC of scores [N] and [P], ties counted half, and its variance by DeLong, DeLong and Clarke-Pearson.

    By ranks, as in Sun and Xu (2014). The variance is 0 where a class has a single score.
    """
    from scipy.stats import rankdata

    n, p = len(negatives), len(positives)
    ranks = rankdata(np.concatenate([negatives, positives]))
    below = (ranks[n:] - rankdata(positives)) / n  # the share of negatives below each positive
    above = 1 - (ranks[:n] - rankdata(negatives)) / p
    variance = float(below.var(ddof=1) / p + above.var(ddof=1) / n) if min(n, p) > 1 else 0.0
    return float(below.mean()), variance


def stegexpose_roc(plain_images: Sequence[Image], stego_images: Sequence[Image]) -> StegExposeRoc:
    """StegExpose on renders of the same views by a plain and by a stego model, [H, W, 3] uint8 each.

    Chi Square takes no image of less than about 87,700 pixels, Sample Pairs none of odd sizes. The AUC of a
    renderer's output should be near 0.5, whatever is hidden: no pixel's last bit is replaced.
    Raises UsageError when the views are not the same in number or size.
    """
    check_same_views(plain_images, stego_images)
    plain, stego = (tuple(map(score_image, images)) for images in (plain_images, stego_images))
    detectors: dict[str, float | None] = {}
    for name in DETECTORS:
        negatives, positives = ([asdict(scores)[name] for scores in each] for each in (plain, stego))
        silent = all(map(_is_missing, negatives + positives))
        detectors[name] = None if silent else roc(negatives, positives).auc
    fused = ([scores.fusion for scores in each] for each in (plain, stego))
    return StegExposeRoc(plain, stego, roc(*fused), detectors)


def check_same_views(plain_images: Sequence[Image], stego_images: Sequence[Image]) -> None:
    """Raises UsageError when the images do not pair up in number and size, or when there are none."""
    sizes = [[list(image.shape[:2]) for image in images] for images in (plain_images, stego_images)]
    if not sizes[0] or sizes[0] != sizes[1]:
        raise UsageError(
            f"expected renders of the same views, got {len(sizes[0])} and {len(sizes[1])} images"
            + (" of different sizes" if len(sizes[0]) == len(sizes[1]) > 0 else "")
        )


def _interval(auc: float, variance: float, pairs: int) -> tuple[float, float]:
    """By DeLong's variance on the logit scale (Pepe 2003).

    There is no variance to go by where one class is a single image or the classes do not overlap at all.
    Disjoint pairs (one of each class) are independent trials then: k of k in order leave 0.025^(1/k)
    possible, whatever the distributions.
    """
    if variance == 0:
        slack = 1 - 0.025 ** (1 / pairs)
        return max(0.0, auc - slack), min(1.0, auc + slack)
    spread = _Z * math.sqrt(variance) / (auc * (1 - auc))
    return float(expit(logit(auc) - spread)), float(expit(logit(auc) + spread))


def _is_missing(score: Score) -> bool:
    return score is None or math.isnan(score)
