"""Groups points by a tree that splits the worst group first, at the mean of its widest axis."""

from __future__ import annotations

import heapq
from typing import Any

import numba
import numpy as np

from keyss.core.arrays import Doubles, Integers


def groups(points: Doubles, size: int) -> tuple[Integers, Integers]:
    """At most `size` groups of `points` [N, D]: indices [N] sorted by group, and where each group starts."""
    order = np.arange(len(points))
    heap = [(0.0, 0, len(points), *_widest(points, order, 0, len(points)))]
    heap[0] = (-heap[0][5], *heap[0][1:])
    done: list[int] = []
    while heap and len(heap) + len(done) < size:
        _, start, end, axis, mean, error = heapq.heappop(heap)
        if error <= 0:
            done.append(start)
            continue
        middle = _split(points, order, start, end, axis, mean)
        for a, b in ((start, middle), (middle, end)):
            axis, mean, error = _widest(points, order, a, b)
            heapq.heappush(heap, (-error, a, b, axis, mean, error))
    return order, np.sort(np.array(done + [each[1] for each in heap]))


def _compiled(function: Any) -> Any:
    """Compile at the first call, and cache the code if a cache folder is writable."""
    jit: Any = numba.njit  # typed in some versions only
    try:
        return jit(function, cache=True, nogil=True)
    except RuntimeError:
        return jit(function, nogil=True)


@_compiled
def _widest(points: Any, order: Any, start: int, end: int) -> Any:
    """(axis of the largest spread of a group, mean along it, squared error of the group)."""
    dimensions = points.shape[1]
    sums, squares = np.zeros(dimensions), np.zeros(dimensions)
    for i in range(start, end):
        for d in range(dimensions):
            value = points[order[i], d]
            sums[d] += value
            squares[d] += value * value
    spread = squares - sums * sums / (end - start)
    axis = int(np.argmax(spread))
    error = spread.sum() if end - start > 1 and spread[axis] > 1e-12 * squares[axis] else 0.0
    return axis, sums[axis] / (end - start), error


@_compiled
def _split(points: Any, order: Any, start: int, end: int, axis: int, mean: float) -> int:
    """Partition a group at `mean` along `axis`; returns where the upper part starts."""
    low, high = start, end - 1
    while low <= high:
        if points[order[low], axis] <= mean:
            low += 1
        else:
            order[low], order[high] = order[high], order[low]
            high -= 1
    return min(max(low, start + 1), end - 1)
