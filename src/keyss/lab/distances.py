"""Distances between the distributions of Gaussians of two models, beside those between control models.

Exact 1-D Wasserstein distances along axes and random directions (sliced Wasserstein, Bonneel et al. 2015) of
features that do not depend on how Gaussians are stored.

Beside them 3D-Sinkhorn as published (KeySS, section 3.3), for comparison with published numbers. It misses
most changes: norms ignore directions, and dividing each model by its own maximum cancels common factors.
Doubled scales, rotated Gaussians and swapped red and blue give the same value as an identical model, which is
not 0. It depends on lengths of quaternions, which do not affect renders.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations
from statistics import fmean

import numpy as np
from torch import Tensor

from keyss.core import Gaussians, UsageError, import_extra
from keyss.core.arrays import Doubles, Floats
from keyss.lab.two_sample import features

SLICES = 32
MAX_GAUSSIANS = 100_000  # Gaussians per model; larger models are subsampled
_RESOLUTION = 1e-6  # relative to a row's largest magnitude: a smaller range is rounding
BINS = 100
REGULARISATION = 0.01


@dataclass(frozen=True)
class AttributeDistance:
    """The distance of one attribute from control models, in units of their 5 to 95 % range."""

    distance: float  # mean over the controls
    control: float  # mean over pairs of controls: seed-to-seed variation
    ratio: float | None  # distance / control; 1 is another training seed; None if `control` is 0
    original: float | None = None  # ratio for the cover's own plain model


def against_controls(
    model: Gaussians, controls: Sequence[Gaussians], *, original: Gaussians | None = None, seed: int = 0
) -> dict[str, AttributeDistance]:
    """`attribute_distances` of `model` and of `controls`, plain models of the same scene from other seeds.

    `original`: another plain model of the scene to compare with the controls, since it can be further from
    them than they are from each other. `controls`: at least two. Raises UsageError for an empty model.
    """

    def mean(pairs: Iterable[tuple[Gaussians, Gaussians]]) -> dict[str, float]:
        every = [attribute_distances(one, two, seed=seed) for one, two in pairs]
        return {name: fmean(distances[name] for distances in every) for name in every[0]}

    stego = mean((control, model) for control in controls)
    between = mean(combinations(controls, 2))
    plain = None if original is None else mean((control, original) for control in controls)
    return {
        name: AttributeDistance(
            stego[name],
            control,
            ratio=stego[name] / control if control else None,
            original=plain[name] / control if plain and control else None,
        )
        for name, control in between.items()
    }


def attribute_distances(reference: Gaussians, other: Gaussians, *, seed: int = 0) -> dict[str, float]:
    """Wasserstein distances of two models' attributes, in units of the reference's 5 to 95 % range.

    Keys are those of `features` (means over axes and 32 random directions) and `joint` (mean over random
    directions in the space of all attributes, equally weighted). Comparisons with one `seed` share their
    directions. If an attribute is constant in the reference, its unit is the range of both models; if it is
    the same constant in both, it is skipped. Models may differ in size and SH degree; those with more than
    `MAX_GAUSSIANS` Gaussians are subsampled. Raises UsageError for an empty model.
    """
    both = [features(model, limit=MAX_GAUSSIANS, seed=seed) for model in (reference, other)]
    generator = np.random.default_rng(seed)
    result, rows = {}, []
    for name in both[0]:
        axes = [model[name].T for model in both]
        along_axes, units = _row_distances(*axes)
        scaled = [_divide(axis, units[:, None]) for axis in axes]
        directions = _directions(generator, len(units))
        along_slices, widths = _row_distances(directions @ scaled[0], directions @ scaled[1])
        result[name] = _mean(np.append(along_axes, along_slices), np.append(units, widths))
        weight = np.float32(1 / np.sqrt(max(int((units > 0).sum()), 1)))
        rows.append([weight * row for row in scaled])
    one, two = (np.concatenate(parts) for parts in zip(*rows, strict=True))
    directions = _directions(generator, len(one))
    result["joint"] = _mean(*_row_distances(directions @ one, directions @ two))
    return result


def _directions(generator: np.random.Generator, size: int) -> Floats:
    """[SLICES, size] random unit vectors; none in one dimension: the axis is enough."""
    vectors = generator.standard_normal((SLICES if size > 1 else 0, size))
    unit: Floats = (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)
    return unit


def _mean(distances: Floats, units: Floats) -> float:
    """The mean over the rows with a range."""
    return float(distances[units > 0].mean()) if (units > 0).any() else 0.0


def _row_distances(reference: Floats, other: Floats) -> tuple[Floats, Floats]:
    """[D] distances of the rows of [D, N] and [D, M] in units of the reference's range, and [D] units.

    Both are 0 for a row that is the same constant in both.
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
    return _divide(areas, units), units


def _divide(values: Floats, units: Floats) -> Floats:
    """`values` / `units` with broadcasting; 0 if the unit is 0."""
    divisors: Floats = np.where(units > 0, units, np.inf)
    return values / divisors


@dataclass(frozen=True)
class Sinkhorn3D:
    """Sinkhorn distances of five histograms, each in [0, 1]."""

    opacity: float
    rotation: float
    scale: float
    position: float
    colour: float
    sum: float  # KeySS, eq. 9; the paper's tables give sums


def sinkhorn_3d(original: Gaussians, other: Gaussians) -> Sinkhorn3D:
    """3D-Sinkhorn of two models.

    Histograms of 100 bins of opacities and of the norms of scales (standard deviations), raw quaternions,
    positions and constant colour coefficients, each divided by the model's own maximum. The bins span
    `original`'s values; values of `other` outside are dropped, and if none is left, the distance is 1. Cost:
    the difference of bin centres. Entropic regularisation: 0.01, hence d(p, p) > 0; at most 1,000 iterations,
    POT's default. Not symmetric. Raises UsageError for an empty model, BackendError without POT.
    """
    if not (len(original) and len(other)):
        raise UsageError("expected two models with Gaussians in them, got an empty one")
    ours, theirs = _magnitudes(original), _magnitudes(other)
    distances = {name: _sinkhorn(ours[name], theirs[name]) for name in ours}
    return Sinkhorn3D(**distances, sum=sum(distances.values()))


def composite_score(psnr_cover: float, psnr_secret: float, distance: float) -> float:
    """The paper's combined score of fidelity and stealth; higher is better (KeySS, eq. 10).

    `distance` is the `sum` of `sinkhorn_3d`; PSNRs in dB.
    """
    return (psnr_cover + psnr_secret) * (1 - distance)


def _magnitudes(gaussians: Gaussians) -> dict[str, Doubles]:
    """[N] magnitudes of each attribute, divided by the largest."""
    flat = gaussians.detach().to("cpu").map(Tensor.double)
    sizes = {
        "opacity": flat.opacities.nan_to_num(0),
        "rotation": flat.quats.norm(dim=1),
        "scale": flat.scales.norm(dim=1),
        "position": flat.means.norm(dim=1),
        "colour": flat.sh[:, 0].norm(dim=1),
    }
    return {name: size.numpy() / (float(size.max()) or 1.0) for name, size in sizes.items()}


def _sinkhorn(original: Doubles, other: Doubles) -> float:
    ot = import_extra("ot", "audit", "compute 3D-Sinkhorn")
    ours, edges = np.histogram(original, BINS)
    theirs, _ = np.histogram(other, edges)
    centres = (edges[:-1] + edges[1:]) / 2
    if not theirs.any():
        return 1.0
    # POT divides by empty bins and returns its initial value; they do not affect the problem.
    i, j = np.flatnonzero(ours), np.flatnonzero(theirs)
    cost = np.abs(centres[i, None] - centres[None, j])
    return float(ot.sinkhorn2(ours[i] / ours.sum(), theirs[j] / theirs.sum(), cost, REGULARISATION))
