"""Nearest neighbours, in subquadratic time even if all points are equal, as in hostile files."""

from __future__ import annotations

import numpy as np
import torch

from keyss.core.arrays import Doubles, Integers


def nearest_neighbours(points: Doubles, count: int, among: Doubles | None = None) -> tuple[Doubles, Integers]:
    """Distances and indices [N, count] of the nearest rows of `among` [M, D], by default `points` [N, D].

    Among equal points, the first ones win. `count` must be at most M.
    """
    return Neighbours(points if among is None else among, count).of(points, torch.get_num_threads())


class Neighbours:
    """A tree of points [M, D] that answers queries for their `count` nearest, at most M."""

    def __init__(self, points: Doubles, count: int) -> None:
        from scipy.spatial import cKDTree  # slow to import

        self.count, self.kept = count, _without_copies(points, count)
        self.tree = cKDTree(points[self.kept])

    def of(self, points: Doubles, threads: int = 1) -> tuple[Doubles, Integers]:
        """Distances and indices [N, count] of the nearest to points [N, D]."""
        distances, nearest = self.tree.query(points, k=np.arange(1, self.count + 1), workers=threads)
        return distances, self.kept[nearest]


def _without_copies(points: Doubles, count: int) -> Integers:
    """The rows of `points` [M, D] in ascending order, of equal ones only the first `count`.

    A tree cannot split equal points: each query would compare all of them.
    """
    first = np.sort(points[:, 0])
    if not (first[count:] == first[:-count]).any():  # the usual case, and five times faster
        return np.arange(len(points))
    rows = np.lexsort(points.T)
    starts = np.flatnonzero(np.append(True, (points[rows[1:]] != points[rows[:-1]]).any(axis=1)))
    copies = np.arange(len(rows)) - np.repeat(starts, np.diff(starts, append=len(rows)))
    return np.sort(rows[copies < count])
