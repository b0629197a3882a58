"""Which of many numbers occur several times, without sorting them all.

Numbers are counted by a hash of a few bits first: only where enough fall to one place are they compared.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from keyss.channels.low_bits import kernels
from keyss.channels.low_bits.bits import KERNEL_BLOCK, Flags
from keyss.rendering.cpu.parallel import in_blocks

Integers = npt.NDArray[np.unsignedinteger[Any]]

_LEAST_BITS, _MOST_BITS = 10, 27  # of places
_MOST_TIMES = 255  # that are counted


def repeated(values: npt.NDArray[np.uint64]) -> Flags:
    """[N] which of the values [N] occur at least twice."""
    found = _crowded(values[:, None], 0, 2, 8)[:, 0]
    rows = np.flatnonzero(found)
    _, inverse, times = np.unique(values[rows], return_inverse=True, return_counts=True)
    found[rows] = times[inverse] > 1
    return found


def crowded(values: npt.NDArray[np.uint32], first: int, least: int) -> npt.NDArray[np.uint32]:
    """Of the values [N, C] from column `first` on all that occur `least` times or more, and some others."""
    candidates: npt.NDArray[np.uint32] = values[:, first:][_crowded(values, first, least, 0.2)]
    return candidates


def _crowded(values: Integers, first: int, least: int, places_each: float) -> Flags:
    """[N, C - first] which values share their place with enough others; places for each of the values."""
    count = values[:, first:].size
    bits = min(max(int(places_each * count).bit_length(), _LEAST_BITS), _MOST_BITS)
    shift, times = np.uint64(64 - bits), np.zeros(1 << bits, np.uint8)
    in_blocks(
        lambda begin, end: kernels.tally(values, first, shift, begin, end, times),
        len(times),
        -(-len(times) // torch.get_num_threads()),
    )
    found = np.empty((len(values), values.shape[1] - first), bool)
    enough = min(least, _MOST_TIMES)
    in_blocks(
        lambda start, stop: kernels.crowded(start, stop, values, first, shift, times, enough, found),
        len(values),
        KERNEL_BLOCK,
    )
    return found
