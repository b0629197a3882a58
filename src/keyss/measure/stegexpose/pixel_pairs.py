"""Primary Sets and Sample Pairs: in which ways neighbours differ, which LSB replacement evens out.

Both count pairs of neighbours (u, v) and solve the same quadratic equation for the rate of embedding.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray


class _Counts(NamedTuple):
    pairs: int
    x: int  # u is below an even v, or above an odd one
    y: int  # the other way round
    z: int  # u equals v
    w: int  # u and v differ in the last bit only
    w_counted: int  # what Primary Sets counts instead: of `y`, all but those where both are even

    def __add__(self, other: tuple[Any, ...]) -> _Counts:
        return _Counts(*(mine + its for mine, its in zip(self, other, strict=True)))


def primary_sets(image: NDArray[np.uint8]) -> float:
    """Rate of embedding in the red channel of [H, W, 3], from horizontal pairs; not bounded.

    NaN where the equation has no real root: rarely for clean photos, nearly always for full payloads.
    """
    counts = _horizontal(image[:, :, 0])
    a, b, _, discriminant = _equation(counts, counts.w_counted)
    with np.errstate(all="ignore"):
        return float((-b - np.sqrt(discriminant)) / (2 * a))


def sample_pairs(image: NDArray[np.uint8]) -> float | None:
    """Mean rate of embedding over the channels of [H, W, 3], from horizontal and vertical pairs; not bounded.

    None when width or height is odd, where the original program fails.
    """
    height, width = image.shape[:2]
    if height % 2 or width % 2:
        return None
    rates = []
    for channel in range(3):
        plane = image[:, :, channel]
        rates.append(_sample_pairs_rate(_horizontal(plane) + _horizontal(plane.T)))
    return float(sum(rates) / 3)


def _sample_pairs_rate(counts: _Counts) -> np.float64:
    a, b, c, discriminant = _equation(counts, counts.w)
    with np.errstate(all="ignore"):
        linear: np.float64 = c / b
        if discriminant < 0:
            return linear
        rate = smaller_root(a, b, discriminant)
        return rate if rate != 0 else linear


def smaller_root(a: np.float64, b: np.float64, discriminant: np.float64) -> np.float64:
    """The root of a x^2 + b x + c nearer to zero, the first at a tie; IEEE arithmetic where a is zero."""
    with np.errstate(all="ignore"):
        first: np.float64 = (-b + np.sqrt(discriminant)) / (2 * a)
        second: np.float64 = (-b - np.sqrt(discriminant)) / (2 * a)
    return first if abs(first) <= abs(second) else second


def _equation(counts: _Counts, w: int) -> tuple[np.float64, np.float64, np.float64, np.float64]:
    """(a, b, c, discriminant) of the equation for the rate."""
    a = np.float64((w + counts.z) / 2)
    b = np.float64(2 * counts.x - counts.pairs)
    c = np.float64(counts.y - counts.x)
    return a, b, c, b * b - 4 * a * c


def _horizontal(plane: NDArray[np.uint8]) -> _Counts:
    """Of the disjoint pairs (0, 1), (2, 3), ... in each row of [H, W]; an odd last column is left out."""
    even = plane.shape[1] // 2 * 2
    u, v = plane[:, 0:even:2], plane[:, 1:even:2]
    odd = (v & 1).astype(bool)
    y = np.where(odd, u < v, u > v)
    pairs, in_y, in_z = u.size, int(np.count_nonzero(y)), int(np.count_nonzero(u == v))
    return _Counts(
        pairs=pairs,
        x=pairs - in_y - in_z,
        y=in_y,
        z=in_z,
        w=int(np.count_nonzero((u ^ v) == 1)),
        w_counted=int(np.count_nonzero(y & (((u | v) & 1) != 0))),
    )
