"""Gaussians as numbers that depend on nothing but what is drawn: what distributions are compared by."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from keyss.core.errors import UsageError
from keyss.core.gaussians import SH_C0, Gaussians
from keyss.files.ply import OPACITY_LOGIT_BOUND

Floats = npt.NDArray[np.float32]

ATTRIBUTES = ("position", "scale", "rotation", "opacity", "colour", "harmonics")


def features(gaussians: Gaussians, *, most: int | None = None, seed: int = 0) -> dict[str, Floats]:
    """[N, D] float32 numbers of each attribute, by the names in `ATTRIBUTES`.

    - `position`: D = 3.
    - `scale`: the 3 log scales in ascending order.
    - `rotation`: the 6 entries of R diag(log s - mean log s) R^T, those off the diagonal times sqrt 2, which
      makes distances Frobenius'. Neither sign nor length of the quaternion nor the order of axes matters.
    - `opacity`: the logit, between -16 and 16; NaN counts as transparent.
    - `colour`: RGB of the constant coefficients.
    - `harmonics`: the 45 other coefficients, zeros where the model's degree is lower than 3.

    With `most`, of a random subset (by `seed`) of at most so many Gaussians. Raises UsageError for an empty
    model.
    """
    if len(gaussians) == 0:
        raise UsageError("expected a model with Gaussians in it, got an empty one")
    flat = gaussians.detach().to("cpu")
    if most is not None and len(flat) > most:
        chosen = np.random.default_rng(seed).choice(len(flat), most, replace=False)
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


def _elongation(quats: Floats, log_scales: Floats) -> npt.NDArray[np.float64]:
    """[N, 6] along what, and by how much, each Gaussian is longer than wide: see `features`."""
    xyzw = quats[:, [1, 2, 3, 0]].astype(np.float64)
    xyzw[~xyzw.any(axis=1), 3] = 1  # zeros turn nothing
    axes = Rotation.from_quat(xyzw).as_matrix()
    lengths = log_scales.astype(np.float64)
    lengths -= lengths.mean(axis=1, keepdims=True)
    tensors = np.einsum("nij,nj,nkj->nik", axes, lengths, axes)
    i, j = np.triu_indices(3)
    entries: npt.NDArray[np.float64] = tensors[:, i, j] * np.where(i == j, 1, np.sqrt(2))
    return entries
