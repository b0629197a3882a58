"""The area under the ROC curve."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from keyss.core import UsageError
from keyss.core.arrays import Doubles

_Z = 1.959963984540054  # standard normal quantile of 0.975


@dataclass(frozen=True)
class Auc:
    """The area under a ROC curve: probability that a positive scores above a negative; ties count half."""

    auc: float  # 0 to 1
    low: float  # 95 % interval, by DeLong (1988)
    high: float


def auc_between(negatives: Sequence[float], positives: Sequence[float]) -> Auc:
    """The AUC of scores that should be higher for positives; NaN is a missing score.

    A missing score counts as lower than every number, so a detector that fails more often on one class can
    have an AUC far from 0.5. The interval treats images as independent and is too narrow for neighbouring
    views. Raises UsageError for an empty class.
    """
    if not negatives or not positives:
        raise UsageError(f"expected scores of both classes, got {len(negatives)} and {len(positives)}")
    plain, stego = (np.where(np.isnan(scores), -np.inf, scores) for scores in (negatives, positives))
    auc, variance = delong(plain, stego)
    return Auc(auc, *_interval(auc, variance, min(len(plain), len(stego))))


def delong(negatives: Doubles, positives: Doubles) -> tuple[float, float]:
    """AUC of scores [N] and [P], and its variance by DeLong, DeLong and Clarke-Pearson.

    Computed from ranks (Sun and Xu, 2014). The variance is 0 if a class has a single score.
    """
    from scipy.stats import rankdata  # slow to import

    n, p = len(negatives), len(positives)
    ranks = rankdata(np.concatenate([negatives, positives]))
    below = (ranks[n:] - rankdata(positives)) / n  # the share of negatives below each positive
    above = 1 - (ranks[:n] - rankdata(negatives)) / p
    variance = float(below.var(ddof=1) / p + above.var(ddof=1) / n) if min(n, p) > 1 else 0.0
    return float(below.mean()), variance


def _interval(auc: float, variance: float, pairs: int) -> tuple[float, float]:
    """The 95 % interval by DeLong's variance on the logit scale (Pepe 2003).

    If the variance is 0, because a class is a single image or the classes do not overlap, the interval is
    that of `pairs` independent pairs, all in order: it reaches an AUC of 0.025^(1 / pairs).
    """
    from scipy.special import expit, logit

    if variance == 0:
        slack = 1 - 0.025 ** (1 / pairs)
        return max(0.0, auc - slack), min(1.0, auc + slack)
    spread = _Z * math.sqrt(variance) / (auc * (1 - auc))
    return float(expit(logit(auc) - spread)), float(expit(logit(auc) + spread))
