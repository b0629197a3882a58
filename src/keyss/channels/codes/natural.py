"""Whether matching would show: levels that many Gaussians share, or that lie on a lattice."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from keyss.channels.codes.fields import Levels

Integers = npt.NDArray[np.int64]

_NEIGHBOURS = 8  # levels away
_ROUGH = 0.25  # by how much more often levels may be equal than near each other
_EQUAL = 0.02  # as a share of the Gaussians
_DEVIATIONS = 6
_LEANING = 0.02  # of the last bits to 0 or to 1


def is_natural(levels: Levels) -> bool:
    """Whether equal levels are not much more frequent than neighbouring ones, nor even more than odd ones."""
    if len(levels) < 2:
        return True
    values, found = np.unique(levels.astype(np.int64), return_counts=True)
    counts = found.astype(np.int64)
    equal = float((counts * (counts - 1)).sum())
    near = [_pairs(values, counts, distance) for distance in range(1, _NEIGHBOURS + 1)]
    expected = float(np.mean(near))
    if equal - expected > max(_ROUGH * expected, _EQUAL * len(levels), _DEVIATIONS * expected**0.5):
        return False
    odd = float((levels & 1).mean())
    return bool(abs(odd - 0.5) < _LEANING + _DEVIATIONS / 2 / len(levels) ** 0.5)


def _pairs(values: Integers, counts: Integers, distance: int) -> float:
    """How many ordered pairs of levels differ by `distance`, upwards."""
    at = np.searchsorted(values, values + distance).clip(max=len(values) - 1)
    there = values[at] == values + distance
    return float((counts[there] * counts[at[there]]).sum())
