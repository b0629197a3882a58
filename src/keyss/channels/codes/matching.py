"""Levels changed as little as can be until their last bits are the wanted ones.

Matching (Sharp 2001), not overwriting: overwriting moves even levels up and odd ones down only, which makes
pairs of them equally frequent and is what the attacks of Westfeld and Pfitzmann (1999) and of Fridrich et al.
(2001) find. Where the numbers before rounding are known, the nearest level to these is taken.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from keyss.channels.codes.fields import Levels

Doubles = npt.NDArray[np.float64]


def matched(levels: Levels, residues: Levels, bits: int, low: Levels, high: Levels, near: Doubles) -> Levels:
    """[M] the levels from `low` to `high` with `residues` modulo 2^bits that are nearest to `near`.

    `near`: the numbers that were rounded to `levels`, or the levels with less than half a level added at
    random, so that of two equally near ones either is taken.
    """
    step = 1 << bits
    target = np.clip(near, levels - 0.5, levels + 0.5)
    found: Levels = (residues + step * np.rint((target - residues) / step)).astype(np.int32)
    found += np.where(found < low, step, 0).astype(np.int32)
    found -= np.where(found > high, step, 0).astype(np.int32)
    return found
