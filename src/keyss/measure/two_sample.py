"""Can a classifier tell the Gaussians of one model from those of another?

The classifier two-sample test of Lopez-Paz and Oquab (ICLR 2017), by the area under the ROC curve: 0.5 is
what two samples of one distribution give, 1 is told apart without fail.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from statistics import fmean

import numpy as np
import numpy.typing as npt

from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.measure.distances import features
from keyss.measure.roc import delong

LEAST, MOST = 100, 10_000  # Gaussians of each model
FOLDS = 5
_CELLS = 8  # along each axis
_TREES, _LEAVES = 50, 16

Ints = npt.NDArray[np.intp]


@dataclass(frozen=True)
class AucInterval:
    """The area under a ROC curve, and its 95 % confidence interval."""

    auc: float
    low: float
    high: float


@dataclass(frozen=True)
class TwoSample:
    """What the classifier says of a model and of controls."""

    stego: tuple[AucInterval, ...]  # the model against each control
    control: tuple[AucInterval, ...]  # each pair of controls
    original: tuple[AucInterval, ...] = ()  # the cover's own plain model against each control


def two_sample_auc(a: Gaussians, b: Gaussians, *, seed: int = 0) -> AucInterval:
    """AUC of boosted trees that tell single Gaussians of `b` from those of `a`.

    The mean over five folds, and its 95 % confidence interval by DeLong's method (1988). Trees see
    `keyss.measure.distances.features`, of as many Gaussians of one model as of the other: random subsets (by
    `seed`) of at most 10,000. Folds are made of cells of space. Were they made of single Gaussians, a
    model against itself would score far below 0.5, for the trees would have learnt from the equal of each
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
    return AucInterval(auc, max(auc - margin, 0.0), min(auc + margin, 1.0))


def two_sample_against_controls(
    model: Gaussians,
    controls: Sequence[Gaussians],
    *,
    original: Gaussians | None = None,
    seed: int = 0,
) -> TwoSample:
    """How well `model` is told from control models of the same scene, beside how well these from each other.

    `original`: another model of the scene, told from the controls too. Raises UsageError for fewer than two
    controls.
    """
    if len(controls) < 2:
        raise UsageError(f"expected at least two control models of the scene, got {len(controls)}")
    others = () if original is None else (original,)
    return TwoSample(
        stego=tuple(two_sample_auc(each, model, seed=seed) for each in controls),
        control=tuple(two_sample_auc(one, two, seed=seed) for one, two in combinations(controls, 2)),
        original=tuple(two_sample_auc(each, other, seed=seed) for each in controls for other in others),
    )


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
