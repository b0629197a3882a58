"""Distances between the Gaussians of two models as distributions, beside those between control models.

Exact 1-D Wasserstein distances along axes and random directions (sliced Wasserstein, Bonneel et al. 2015) of
features that are equal for equal Gaussians, however they are stored. They detect what 3D-Sinkhorn misses: see
`keyss.measure.sinkhorn`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from statistics import fmean
from typing import Any, Generic, TypeVar

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from keyss.core import SH_C0, Gaussians, UsageError, import_extra
from keyss.files.ply_rows import OPACITY_LOGIT_BOUND

Floats = npt.NDArray[np.float32]

ATTRIBUTES = ("position", "scale", "rotation", "opacity", "colour", "harmonics")
SLICES = 32
MAX_GAUSSIANS = 100_000  # of each model; larger ones are subsampled
_RESOLUTION = 1e-6  # of a row's largest magnitude: a smaller range is rounding


T = TypeVar("T")


@dataclass(frozen=True)
class Beside(Generic[T]):
    """A measure of two models, taken of a model and of control models of its scene."""

    stego: tuple[T, ...]  # each control against the model
    control: tuple[T, ...]  # each pair of controls: seed-to-seed variation
    original: tuple[T, ...] = ()  # each control against the cover's own plain model


def beside_controls(
    measure: Callable[[Gaussians, Gaussians], T],
    model: Gaussians,
    controls: Sequence[Gaussians],
    original: Gaussians | None = None,
) -> Beside[T]:
    """Take a measure of `model` and of `controls`, plain models of the same scene from other seeds.

    `original`: another plain model of the scene that is compared with the controls too, since it can be
    further from them than they are from each other. Raises UsageError for fewer than two controls.
    """
    if len(controls) < 2:
        raise UsageError(f"expected at least two control models of the scene, got {len(controls)}")
    return Beside(
        stego=tuple(measure(control, model) for control in controls),
        control=tuple(measure(one, two) for one, two in combinations(controls, 2)),
        original=() if original is None else tuple(measure(control, original) for control in controls),
    )


@dataclass(frozen=True)
class AttributeDistance:
    """The distance of one attribute from control models, in units of their 5 to 95 % range."""

    distance: float  # mean over the controls
    control: float  # mean over pairs of controls: seed-to-seed variation
    ratio: float | None  # distance / control; 1 is another training seed; None if `control` is 0
    original: float | None = None  # the same ratio for the cover's own plain model


def against_controls(
    model: Gaussians,
    controls: Sequence[Gaussians],
    *,
    original: Gaussians | None = None,
    seed: int = 0,
) -> dict[str, AttributeDistance]:
    """`attribute_distances` by attribute: see `beside_controls`. Raises UsageError for an empty model."""
    result = beside_controls(partial(attribute_distances, seed=seed), model, controls, original)
    rows = {}
    for name in result.control[0]:
        stego, control = (fmean(each[name] for each in group) for group in (result.stego, result.control))
        ratio = own = None
        if control:
            ratio = stego / control
            own = fmean(each[name] for each in result.original) / control if result.original else None
        rows[name] = AttributeDistance(stego, control, ratio, own)
    return rows


def attribute_distances(reference: Gaussians, other: Gaussians, *, seed: int = 0) -> dict[str, float]:
    """Wasserstein distances of two models' attributes, in units of the reference's 5 to 95 % range.

    By attribute, as in `features`: the mean over its axes and 32 random directions. `joint`: the mean over
    random directions in the space of all attributes, equally weighted. All comparisons with one `seed` share
    their directions. An attribute that is constant in the reference is measured in units of the range of both
    models; one that is the same constant in both is skipped. Models may differ in size and SH degree; one
    with more than `MAX_GAUSSIANS` Gaussians is subsampled. Raises UsageError for an empty model.
    """
    both = [features(model, limit=MAX_GAUSSIANS, seed=seed) for model in (reference, other)]
    generator = np.random.default_rng(seed)
    result, rows = {}, []
    for name in ATTRIBUTES:
        axes = [model[name].T for model in both]
        along_axes, units = _along(*axes)
        scaled = [_in_units(each, units[:, None]) for each in axes]
        directions = _directions(generator, len(units))
        along_slices, widths = _along(directions @ scaled[0], directions @ scaled[1])
        result[name] = _mean(np.append(along_axes, along_slices), np.append(units, widths))
        weight = np.float32(1 / np.sqrt(max(int((units > 0).sum()), 1)))
        rows.append([weight * each for each in scaled])
    one, two = (np.concatenate(parts) for parts in zip(*rows, strict=True))
    directions = _directions(generator, len(one))
    result["joint"] = _mean(*_along(directions @ one, directions @ two))
    return result


def features(gaussians: Gaussians, *, limit: int | None = None, seed: int = 0) -> dict[str, Floats]:
    """[N, D] float32 features of each attribute in `ATTRIBUTES`.

    - `position`: D = 3.
    - `scale`: the 3 log scales in ascending order.
    - `rotation`: the 6 entries of R diag(log s - mean log s) R^T, with those off the diagonal times sqrt 2,
      for Frobenius distances. Sign and length of the quaternion and the order of axes do not matter.
    - `opacity`: the logit, clamped to -16 and 16; NaN counts as transparent.
    - `colour`: RGB of the constant coefficients.
    - `harmonics`: the 45 other coefficients, zeros above the model's degree.

    `limit`: the maximum number of Gaussians, chosen at random by `seed`. Raises UsageError for an empty
    model.
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


def space_cells(positions: npt.NDArray[np.floating[Any]], per_axis: int) -> npt.NDArray[np.intp]:
    """[N] index of the cell of each position [N, 3]; cells lie between quantiles of the coordinates."""
    cuts = np.quantile(positions, np.arange(1, per_axis) / per_axis, axis=0)
    index = [np.searchsorted(cuts[:, axis], positions[:, axis]) for axis in range(3)]
    cells: npt.NDArray[np.intp] = np.ravel_multi_index(index, (per_axis,) * 3)
    return cells


def _directions(generator: np.random.Generator, size: int) -> Floats:
    """[SLICES, size] random unit vectors; none in one dimension, where the axis is enough."""
    vectors = generator.standard_normal((SLICES if size > 1 else 0, size))
    unit: Floats = (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)
    return unit


def _mean(distances: Floats, units: Floats) -> float:
    """Over the rows with a range."""
    return float(distances[units > 0].mean()) if (units > 0).any() else 0.0


def _along(reference: Floats, other: Floats) -> tuple[Floats, Floats]:
    """[D] distances of the rows of [D, N] and [D, M] in units of the reference's range, and the units [D].

    Both are 0 for a row that is one constant in both.
    """
    one, two = np.sort(reference, axis=1), np.sort(other, axis=1)
    last = one.shape[1] - 1
    span = np.maximum(one[:, -1], two[:, -1]) - np.minimum(one[:, 0], two[:, 0])
    ends = np.stack([one[:, 0], one[:, -1], two[:, 0], two[:, -1]])
    smallest = np.float32(_RESOLUTION) * np.abs(ends).max(axis=0)
    units = one[:, round(0.95 * last)] - one[:, round(0.05 * last)]
    units = np.where(units > smallest, units, np.where(span > smallest, span, 0))
    if one.shape == two.shape:
        areas: Floats = np.abs(one - two).mean(axis=1)
    else:
        ot = import_extra("ot", "audit", "compute distances")
        areas = ot.wasserstein_1d(one.T.astype(np.float64), two.T.astype(np.float64), require_sort=False)
    return _in_units(areas, units), units


def _in_units(values: Floats, units: Floats) -> Floats:
    """`values` / `units`, which broadcast; 0 where the unit is 0."""
    divisors: Floats = np.where(units > 0, units, np.inf)
    return values / divisors


def _elongation(quats: Floats, log_scales: Floats) -> npt.NDArray[np.float64]:
    """[N, 6] direction and amount of each Gaussian's elongation: see `features`."""
    xyzw = quats[:, [1, 2, 3, 0]].astype(np.float64)
    xyzw[~xyzw.any(axis=1), 3] = 1  # a zero quaternion means no rotation
    axes = Rotation.from_quat(xyzw).as_matrix()
    lengths = log_scales.astype(np.float64)
    lengths -= lengths.mean(axis=1, keepdims=True)
    tensors = np.einsum("nij,nj,nkj->nik", axes, lengths, axes)
    i, j = np.triu_indices(3)
    entries: npt.NDArray[np.float64] = tensors[:, i, j] * np.where(i == j, 1, np.sqrt(2))
    return entries
