"""3D-Sinkhorn as published (KeySS, section 3.3): a measure to be comparable by.

It is blind to most changes. A norm says nothing of direction, and dividing each model by its own maximum
cancels any common factor: doubled scales, turned Gaussians or colours with red and blue exchanged give
exactly what the identical model gives, which is not 0 either. It does answer to the lengths of quaternions,
which nobody sees. `keyss.measure.distances` has none of these faults.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from torch import Tensor

from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians

BINS = 100
REGULARISATION = 0.01

Doubles = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Sinkhorn3D:
    """Sinkhorn distances of five histograms, each in [0, 1]."""

    opacity: float
    rotation: float
    scale: float
    position: float
    colour: float
    mean: float
    sum: float  # KeySS, eq. 9; the paper's tables give sums


def sinkhorn_3d(original: Gaussians, other: Gaussians) -> Sinkhorn3D:
    """3D-Sinkhorn of two models.

    The histograms, of 100 bins, are of opacities and of the lengths of scales (as standard deviations), raw
    quaternions, positions and constant colour coefficients, each model's divided by its own maximum. The
    range of `original`'s values is divided into bins; what of `other` lies outside it is dropped, and if that
    is all of it, the distance is 1. Cost: the difference of the bins' centres. Entropic regularisation: 0.01,
    so d(p, p) > 0; at most 1,000 iterations, as is POT's default. Not symmetric.
    Raises UsageError for an empty model.
    """
    if not (len(original) and len(other)):
        raise UsageError("expected two models with Gaussians in them, got an empty one")
    ours, theirs = _magnitudes(original), _magnitudes(other)
    found = {name: _sinkhorn(ours[name], theirs[name]) for name in ours}
    total = sum(found.values())
    return Sinkhorn3D(**found, mean=total / len(found), sum=total)


def composite_score(psnr_cover: float, psnr_secret: float, distance: float) -> float:
    """The paper's one number for fidelity and stealth, the greater the better (KeySS, eq. 10).

    `distance` is the `sum` of `sinkhorn_3d`; PSNRs in dB.
    """
    return (psnr_cover + psnr_secret) * (1 - distance)


def _magnitudes(gaussians: Gaussians) -> dict[str, Doubles]:
    """[N] non-negative numbers of each attribute, divided by the largest."""
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
    import ot  # slow to import

    ours, edges = np.histogram(original, BINS)
    theirs, _ = np.histogram(other, edges)
    centres = (edges[:-1] + edges[1:]) / 2
    if not theirs.any():
        return 1.0
    # Empty bins take no part in the problem, but POT divides by them and returns what it started from.
    i, j = np.flatnonzero(ours), np.flatnonzero(theirs)
    cost = np.abs(centres[i, None] - centres[None, j])
    return float(ot.sinkhorn2(ours[i] / ours.sum(), theirs[j] / theirs.sum(), cost, REGULARISATION))
