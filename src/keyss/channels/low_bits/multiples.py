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

_LEAST_BITS, _MOST_BITS = 10, 27  # of the number of places
_MOST_TIMES = 255  # that are counted


def repeated(values: npt.NDArray[np.uint64]) -> Flags:
    """[N] which of the values [N] occur at least twice. On one thread."""
    shift, places = _places(8, len(values))
    seen, twice = (np.zeros(places // 64, np.uint64) for _ in range(2))  # a bit for each place
    kernels.meet(values, shift, seen, twice)
    rows = np.empty(len(values), np.int64)
    rows = rows[: kernels.met(values, shift, twice, rows)]
    some = values[rows]
    ordered = np.sort(some)
    equal = np.unique(ordered[1:][ordered[1:] == ordered[:-1]])
    found = np.zeros(len(values), bool)
    if len(equal):
        found[rows] = equal[np.searchsorted(equal, some).clip(max=len(equal) - 1)] == some
    return found


def crowded(values: npt.NDArray[np.uint32], first: int, least: int) -> npt.NDArray[np.uint32]:
    """Of the values [N, C] from column `first` on all that occur `least` times or more, and some others."""
    columns = values.shape[1] - first
    shift, places = _places(0.1, len(values) * columns)

    def tally(start: int, stop: int) -> npt.NDArray[np.uint8]:
        times = np.zeros(places, np.uint8)
        kernels.tally(start, min(stop, len(values)), values, first, shift, times)
        return times

    rows = max(1, len(values))
    times, *others = in_blocks(tally, rows, -(-rows // torch.get_num_threads()))  # a table for each thread
    for each in others:
        times += np.minimum(each, _MOST_TIMES - times)
    enough = np.packbits(times >= min(least, _MOST_TIMES), bitorder="little")

    def choose(start: int, stop: int) -> Any:
        chosen = np.empty((stop - start) * columns, np.uint32)
        return chosen[: kernels.crowded(start, stop, values, first, shift, enough, chosen)].copy()

    return np.concatenate([np.zeros(0, np.uint32), *in_blocks(choose, len(values), KERNEL_BLOCK)])


def _places(each: float, count: int) -> tuple[np.uint64, int]:
    """By how much a hash of 64 bits is shifted to tell its place, and how many places there are.

    At least `each` of them for each of `count` values, as far as there may be so many.
    """
    bits = min(max(int(each * count).bit_length(), _LEAST_BITS), _MOST_BITS)
    return np.uint64(64 - bits), 1 << bits
