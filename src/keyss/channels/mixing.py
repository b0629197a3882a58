"""A hash of 64-bit numbers that anybody can compute: it scatters and hides nothing."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Words = npt.NDArray[np.uint64]


def mixed(words: Words) -> Words:
    """[...] numbers that look random for different ones: the finaliser of splitmix64 (Steele et al. 2014)."""
    state = words.astype(np.uint64) + np.uint64(0x9E3779B97F4A7C15)
    state = (state ^ state >> np.uint64(30)) * np.uint64(0xBF58476D1CE4E5B9)
    state = (state ^ state >> np.uint64(27)) * np.uint64(0x94D049BB133111EB)
    result: Words = state ^ state >> np.uint64(31)
    return result
