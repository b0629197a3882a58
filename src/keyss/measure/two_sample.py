"""The classifier two-sample test (Lopez-Paz and Oquab, ICLR 2017) between the Gaussians of two models.

Its statistic is the area under the ROC curve: 0.5 for two samples of one distribution, 1 for perfect
separation.
"""

from __future__ import annotations

from statistics import fmean

import numpy as np
import numpy.typing as npt

from keyss.core import Gaussians, UsageError, import_extra
from keyss.measure.auc import Auc, delong
from keyss.measure.distances import features, space_cells

MIN_GAUSSIANS, MAX_GAUSSIANS = 100, 10_000  # of each model
FOLDS = 5
_CELLS = 8  # along each axis
_TREES, _LEAVES = 50, 16

Ints = npt.NDArray[np.intp]


def two_sample_auc(a: Gaussians, b: Gaussians, *, seed: int = 0) -> Auc:
    """AUC of boosted trees that distinguish single Gaussians of `b` from those of `a`.

    The mean over five folds, with its 95 % confidence interval by DeLong's method (1988). Trees see
    `keyss.measure.distances.features` of equally many Gaussians of both models, at most 10,000 random ones.
    Folds consist of cells of space: with folds of single Gaussians, the trees would learn each held-out
    Gaussian's equal under the opposite label, and a model against itself would score far below 0.5. Raises
    UsageError for a model of fewer than 100 Gaussians or of too few distinct positions for five folds, and
    BackendError without scikit-learn.
    """
    size = min(len(a), len(b), MAX_GAUSSIANS)
    if size < MIN_GAUSSIANS:
        raise UsageError(f"expected at least {MIN_GAUSSIANS} Gaussians in each model, got {size}")
    parts = [features(model, limit=size, seed=seed) for model in (a, b)]
    values = np.concatenate([np.concatenate(list(part.values()), axis=1) for part in parts])
    is_b = np.arange(2 * size) >= size
    fold = _folds(np.concatenate([part["position"] for part in parts]), seed)
    if np.bincount(2 * fold + is_b, minlength=2 * FOLDS).min() < 2:
        raise UsageError(
            "expected Gaussians spread over space, but they lie in too few places for five folds"
        )
    aucs, variances = zip(
        *(_held_out(values, is_b, fold == index, seed) for index in range(FOLDS)), strict=True
    )
    auc, margin = fmean(aucs), 1.96 * sum(variances) ** 0.5 / FOLDS
    return Auc(auc, max(auc - margin, 0.0), min(auc + margin, 1.0))


def _folds(positions: npt.NDArray[np.float32], seed: int) -> Ints:
    """[N] the fold of each Gaussian; each cell of space has a random one."""
    _, cell = np.unique(space_cells(positions, _CELLS), return_inverse=True)
    folds: Ints = np.random.default_rng(seed).permutation(cell.max() + 1)[cell] % FOLDS
    return folds


def _held_out(
    values: npt.NDArray[np.float32], is_b: npt.NDArray[np.bool_], held_out: npt.NDArray[np.bool_], seed: int
) -> tuple[float, float]:
    """AUC on held-out Gaussians of trees trained on the others, and its variance."""
    ensemble = import_extra("sklearn.ensemble", "audit", "train classifiers")
    threadpoolctl = import_extra("threadpoolctl", "audit", "train classifiers")
    trees = ensemble.HistGradientBoostingClassifier(
        max_iter=_TREES, max_leaf_nodes=_LEAVES, early_stopping=False, random_state=seed
    )
    with threadpoolctl.threadpool_limits(1, "openmp"):  # so few rows do not keep several threads busy
        trees.fit(values[~held_out], is_b[~held_out])
        scores = trees.decision_function(values[held_out])
    return delong(scores[~is_b[held_out]], scores[is_b[held_out]])
