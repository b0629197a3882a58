"""Quaternions without their largest part: the others may not become larger than it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from keyss.channels.codes.fields import Flags, Levels


def kept_smaller(
    before: Levels, after: Levels, usable: Flags, bits: int, centre: float, step: float
) -> Levels:
    """[N, 3] `after` with the same last bits, where a part became larger than the one that is left out.

    `usable` [N, 3]: what may be changed. `centre`, `step`: a level stands for (level - centre) * step. What
    was so `before`, by rounding, is left: a file without any would be noticed, too.
    """
    too_large = _too_large(after, centre, step) & ~_too_large(before, centre, step) & usable
    found: Levels = after - (np.sign(after - centre) * too_large * (1 << bits)).astype(np.int32)
    return found


def _too_large(levels: Levels, centre: float, step: float) -> npt.NDArray[np.bool_]:
    """[N, 3] which parts are larger than the largest."""
    parts = np.abs(levels - centre) * step
    rest = np.sqrt(np.maximum(0.0, 1 - np.square(parts).sum(axis=1, keepdims=True)))
    found: npt.NDArray[np.bool_] = parts > rest
    return found
