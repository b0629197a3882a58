"""The classifier two-sample test (Lopez-Paz and Oquab, ICLR 2017) between the Gaussians of two models.

Its statistic is the area under the ROC curve: 0.5 for two samples of one distribution, 1 for perfect
separation. It detects what 3D-Sinkhorn misses: see `keyss.lab.distances`.
"""

from __future__ import annotations

from statistics import fmean

import numpy as np
from scipy.spatial.transform import Rotation

from keyss.core import SH_C0, Gaussians, UsageError, import_extra
from keyss.core.arrays import Doubles, Flags, Floats, Integers, Numbers
from keyss.files.ply_table import OPACITY_LOGIT_BOUND
from keyss.lab.auc import Auc, delong

MIN_GAUSSIANS, MAX_GAUSSIANS = 100, 10_000  # Gaussians per model
FOLDS = 5
_CELLS = 8  # along each axis
TREES, _LEAVES = 50, 16


def two_sample_auc(a: Gaussians, b: Gaussians, *, seed: int = 0) -> Auc:
    """AUC of boosted trees that distinguish single Gaussians of `b` from those of `a`.

    The mean over five folds, with its 95 % confidence interval by DeLong's method (1988). Trees see
    `features` of equal numbers of Gaussians of both models, at most 10,000 each. Folds consist of cells of
    space: with random folds, the trees would learn a held-out Gaussian's duplicate under the opposite label,
    and a model against itself would score far below 0.5. Raises UsageError for a model of fewer than 100
    Gaussians or of too few distinct positions for five folds, BackendError without scikit-learn.
    """
    size = min(len(a), len(b), MAX_GAUSSIANS)
    if size < MIN_GAUSSIANS:
        raise UsageError(f"expected at least {MIN_GAUSSIANS} Gaussians in each model, got {size}")
    parts = [features(model, limit=size, seed=seed) for model in (a, b)]
    values = np.concatenate([np.concatenate(list(part.values()), axis=1) for part in parts])
    is_b = np.arange(2 * size) >= size
    # Cells of space are assigned to folds at random.
    cells = space_cells(np.concatenate([part["position"] for part in parts]), _CELLS)
    _, cell = np.unique(cells, return_inverse=True)
    fold = np.random.default_rng(seed).permutation(cell.max() + 1)[cell] % FOLDS
    if np.bincount(2 * fold + is_b, minlength=2 * FOLDS).min() < 2:
        raise UsageError(
            "expected Gaussians spread over space, but they lie in too few places for five folds"
        )
    aucs, variances = zip(
        *(_held_out_auc(values, is_b, fold == index, seed) for index in range(FOLDS)), strict=True
    )
    auc, margin = fmean(aucs), 1.96 * sum(variances) ** 0.5 / FOLDS
    return Auc(auc, max(auc - margin, 0.0), min(auc + margin, 1.0))


def features(gaussians: Gaussians, *, limit: int | None = None, seed: int = 0) -> dict[str, Floats]:
    """[N, D] float32 features of each attribute.

    - `position`: D = 3.
    - `scale`: the 3 log scales in ascending order.
    - `rotation`: the 6 entries of R diag(log s - mean log s) R^T, off-diagonal ones times sqrt 2
      for Frobenius distances. Invariant to sign and length of the quaternion and to the order of axes.
    - `opacity`: the logit, clamped to -16 and 16; NaN counts as transparent.
    - `colour`: RGB of the constant coefficients.
    - `harmonics`: the 45 other coefficients, zeros above the model's degree.

    `limit`: maximum number of Gaussians, sampled with `seed`. Raises UsageError for an empty model.
    """
    if len(gaussians) == 0:
        raise UsageError("expected a model with Gaussians in it, got an empty one")
    flat = gaussians.detach().to("cpu")
    if limit is not None and len(flat) > limit:
        chosen = np.random.default_rng(seed).choice(len(flat), limit, replace=False)
        flat = flat.map(lambda tensor: tensor[chosen])
    log_scales, sh = flat.log_scales.numpy(), flat.with_sh_degree(3).sh.numpy()
    logits = np.nan_to_num(flat.opacity_logits.numpy(), nan=-OPACITY_LOGIT_BOUND)
    columns = {
        "position": flat.means.numpy(),
        "scale": np.sort(log_scales, axis=1),
        "rotation": _elongation(flat.quats.numpy(), log_scales),
        "opacity": logits.clip(-OPACITY_LOGIT_BOUND, OPACITY_LOGIT_BOUND)[:, None],
        "colour": SH_C0 * sh[:, 0] + 0.5,
        "harmonics": sh[:, 1:].reshape(len(sh), 45),
    }
    return {name: values.astype(np.float32) for name, values in columns.items()}


def space_cells(positions: Numbers, per_axis: int) -> Integers:
    """[N] index of the cell of each position [N, 3]; cells lie between quantiles of the coordinates."""
    cuts = np.quantile(positions, np.arange(1, per_axis) / per_axis, axis=0)
    index = [np.searchsorted(cuts[:, axis], positions[:, axis]) for axis in range(3)]
    return np.ravel_multi_index(index, (per_axis,) * 3)


def _held_out_auc(values: Floats, is_b: Flags, held_out: Flags, seed: int) -> tuple[float, float]:
    """AUC and its variance on held-out Gaussians, for trees trained on the others."""
    ensemble = import_extra("sklearn.ensemble", "audit", "train classifiers")
    threadpoolctl = import_extra("threadpoolctl", "audit", "train classifiers")
    trees = ensemble.HistGradientBoostingClassifier(
        max_iter=TREES, max_leaf_nodes=_LEAVES, early_stopping=False, random_state=seed
    )
    with threadpoolctl.threadpool_limits(1, "openmp"):  # too few rows for several threads
        trees.fit(values[~held_out], is_b[~held_out])
        scores = trees.decision_function(values[held_out])
    return delong(scores[~is_b[held_out]], scores[is_b[held_out]])


def _elongation(quats: Floats, log_scales: Floats) -> Doubles:
    """[N, 6] the feature `rotation`; see `features`."""
    xyzw = quats[:, [1, 2, 3, 0]].astype(np.float64)
    xyzw[~xyzw.any(axis=1), 3] = 1  # a zero quaternion means no rotation
    axes = Rotation.from_quat(xyzw).as_matrix()
    lengths = log_scales.astype(np.float64)
    lengths -= lengths.mean(axis=1, keepdims=True)
    tensors = np.einsum("nij,nj,nkj->nik", axes, lengths, axes)
    i, j = np.triu_indices(3)
    entries: Doubles = tensors[:, i, j] * np.where(i == j, 1, np.sqrt(2))
    return entries
