"""The published 3D-Sinkhorn (KeySS, section 3.3), for comparison with published numbers.

It misses most changes: norms ignore directions, and dividing each model by its own maximum cancels common
factors. Doubled scales, rotated Gaussians and swapped red and blue give the same value as an identical model,
which is not 0. It depends on lengths of quaternions, which do not affect renders. `keyss.lab.distances` has
none of these faults.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from torch import Tensor

from keyss.core import Gaussians, UsageError, import_extra
from keyss.core.arrays import Doubles

BINS = 100
REGULARISATION = 0.01


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
