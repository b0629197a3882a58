"""Which of many numbers occur several times, without sorting them all.

Numbers are counted by a hash of a few bits first: only where enough fall to one place are they compared.
"""

from __future__ import annotations

from collections.abc import Callable
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
    parts = _crowded(values[:, None], 0, 2, 8, lambda _, found: found[:, 0])
    found: Flags = np.concatenate([np.zeros(0, bool), *parts])
    rows = np.flatnonzero(found)
    _, inverse, times = np.unique(values[rows], return_inverse=True, return_counts=True)
    found[rows] = times[inverse] > 1
    return found


def crowded(values: npt.NDArray[np.uint32], first: int, least: int) -> npt.NDArray[np.uint32]:
    """Of the values [N, C] from column `first` on all that occur `least` times or more, and some others."""
    parts = _crowded(values, first, least, 0.2, lambda part, found: part[:, first:][found])
    return np.concatenate([np.zeros(0, np.uint32), *parts])


def _crowded(
    values: Integers, first: int, least: int, places_each: float, chosen: Callable[[Any, Flags], Any]
) -> list[Any]:
    """For some rows at a time what is `chosen` of them and [n, C - first] which of their values share their
    place with enough others. There are `places_each` for each of the values.
    """
    count = values[:, first:].size
    bits = min(max(int(places_each * count).bit_length(), _LEAST_BITS), _MOST_BITS)
    shift, rows = np.uint64(64 - bits), max(1, len(values))

    def tally(start: int, stop: int) -> npt.NDArray[np.uint8]:
        times = np.zeros(1 << bits, np.uint8)
        kernels.tally(start, min(stop, len(values)), values, first, shift, times)
        return times

    times, *others = in_blocks(tally, rows, -(-rows // torch.get_num_threads()))  # a table for each thread
    for each in others:
        times += np.minimum(each, _MOST_TIMES - times)
    places = np.packbits(times >= min(least, _MOST_TIMES), bitorder="little")

    def choose(start: int, stop: int) -> Any:
        part = values[start:stop]
        found = np.empty((len(part), values.shape[1] - first), bool)
        kernels.crowded(part, first, shift, places, found)
        return chosen(part, found)

    return in_blocks(choose, len(values), KERNEL_BLOCK)
