"""Can a classifier tell the Gaussians of one model from those of another?

The classifier two-sample test of Lopez-Paz and Oquab (ICLR 2017), by the area under the ROC curve: 0.5 is
what two samples of one distribution give, 1 is told apart without fail.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from statistics import fmean
from typing import Any

import numpy as np
import numpy.typing as npt

from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.measure.features import features

LEAST, MOST = 100, 10_000  # Gaussians of each model
FOLDS = 5
_CELLS = 8  # along each axis
_TREES, _LEAVES = 50, 16

Doubles = npt.NDArray[np.float64]
Ints = npt.NDArray[np.intp]


def two_sample_auc(a: Gaussians, b: Gaussians, *, seed: int = 0) -> dict[str, float]:
    """`auc` of boosted trees that tell single Gaussians of `b` from those of `a`, `low` and `high`.

    The mean over five folds, and its 95 % confidence interval by DeLong's method (1988). Trees see
    `keyss.measure.features.features`, of as many Gaussians of one model as of the other: random subsets (by
    `seed`) of at most 10,000. Folds are made of cells of space. Were they made of single Gaussians, a
    model against itself would score far below 0.5, for the trees would have learnt from the twin of each
    Gaussian held out, with the other label. Raises UsageError for a model of fewer than 100 Gaussians, or
    whose Gaussians lie in so few places that there are no five folds.
    """
    size = min(len(a), len(b), MOST)
    if size < LEAST:
        raise UsageError(f"expected at least {LEAST} Gaussians in each model, got {size}")
    parts = [features(model, most=size, seed=seed) for model in (a, b)]
    values = np.concatenate([np.concatenate(list(part.values()), axis=1) for part in parts])
    is_b = np.arange(2 * size) >= size
    fold = _folds(np.concatenate([part["position"] for part in parts]), seed)
    if np.bincount(2 * fold + is_b, minlength=2 * FOLDS).min() < 2:
        raise UsageError(
            "expected Gaussians spread over space, but they lie in too few places to divide them"
        )
    aucs, variances = zip(
        *(_held_out(values, is_b, fold == index, seed) for index in range(FOLDS)), strict=True
    )
    auc, margin = fmean(aucs), 1.96 * sum(variances) ** 0.5 / FOLDS
    return {"auc": auc, "low": max(auc - margin, 0.0), "high": min(auc + margin, 1.0)}


def two_sample_against_null(
    model: Gaussians, plain_models: Sequence[Gaussians], *, seed: int = 0
) -> dict[str, Any]:
    """How well `model` is told from plain models of the same scene, beside how well these from each other.

    `auc` and `null` are means; `against_plain` and `between_plain` hold what `two_sample_auc` says of each
    plain model and of each pair. Raises UsageError for fewer than two plain models.
    """
    if len(plain_models) < 2:
        raise UsageError(f"a null needs at least two plain models of the scene, got {len(plain_models)}")
    against = [two_sample_auc(plain, model, seed=seed) for plain in plain_models]
    between = [two_sample_auc(one, two, seed=seed) for one, two in combinations(plain_models, 2)]
    return {
        "auc": fmean(each["auc"] for each in against),
        "null": fmean(each["auc"] for each in between),
        "against_plain": against,
        "between_plain": between,
    }


def _folds(positions: npt.NDArray[np.float32], seed: int) -> Ints:
    """[N] a random fold for each cell of space, the cells cut where quantiles of each coordinate are."""
    cuts = np.quantile(positions, np.arange(1, _CELLS) / _CELLS, axis=0)
    index = [np.searchsorted(cuts[:, axis], positions[:, axis], side="right") for axis in range(3)]
    _, cell = np.unique(np.ravel_multi_index(index, (_CELLS,) * 3), return_inverse=True)
    folds: Ints = np.random.default_rng(seed).permutation(cell.max() + 1)[cell] % FOLDS
    return folds


def _held_out(
    values: npt.NDArray[np.float32], is_b: npt.NDArray[np.bool_], held_out: npt.NDArray[np.bool_], seed: int
) -> tuple[float, float]:
    """AUC on the Gaussians held out, of trees that learn from the others, and its variance."""
    from sklearn.ensemble import HistGradientBoostingClassifier  # slow to import
    from threadpoolctl import threadpool_limits

    trees = HistGradientBoostingClassifier(
        max_iter=_TREES, max_leaf_nodes=_LEAVES, early_stopping=False, random_state=seed
    )
    with threadpool_limits(1, "openmp"):  # on so few rows threads wait for each other most of the time
        trees.fit(values[~held_out], is_b[~held_out])
        scores = trees.decision_function(values[held_out])
    return delong(scores[~is_b[held_out]], scores[is_b[held_out]])


def delong(negatives: Doubles, positives: Doubles) -> tuple[float, float]:
    """AUC of scores [N] and [P], ties counted half, and its variance by DeLong, DeLong and Clarke-Pearson.

    By ranks, as in Sun and Xu (2014).
    """
    from scipy.stats import rankdata

    n, p = len(negatives), len(positives)
    ranks = rankdata(np.concatenate([negatives, positives]))
    below = (ranks[n:] - rankdata(positives)) / n  # the share of negatives below each positive
    above = 1 - (ranks[:n] - rankdata(negatives)) / p
    return float(below.mean()), float(below.var(ddof=1) / p + above.var(ddof=1) / n)
