"""Nearest neighbours, in time that does not grow with the square of equal points, as in hostile files."""

from __future__ import annotations

import numpy as np

from keyss.core.arrays import Doubles, Integers


def nearest_neighbours(points: Doubles, count: int, among: Doubles | None = None) -> tuple[Doubles, Integers]:
    """Distances and indices [N, count] of the nearest of `among` [M, D], by default of the `points` [N, D].

    Of more than `count` equal points the first ones are found. `count` must be at most M.
    """
    from scipy.spatial import cKDTree  # slow to import, and most commands need no neighbours

    among = points if among is None else among
    # A tree cannot split equal points: each query would compare all of them.
    rows = np.lexsort(among.T)
    starts = np.append(True, (among[rows[1:]] != among[rows[:-1]]).any(axis=1))
    copies = np.arange(len(rows)) - np.flatnonzero(starts)[np.cumsum(starts) - 1]
    kept = np.sort(rows[copies < count])
    distances, nearest = cKDTree(among[kept]).query(points, k=np.arange(1, count + 1))
    return distances, kept[nearest]
