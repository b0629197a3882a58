"""Nearest neighbours, in subquadratic time even if all points are equal, as in hostile files."""

from __future__ import annotations

import numpy as np
import torch

from keyss.core.arrays import Doubles, Integers


def nearest_neighbours(points: Doubles, count: int, among: Doubles | None = None) -> tuple[Doubles, Integers]:
    """Distances and indices [N, count] of the nearest rows of `among` [M, D], by default `points` [N, D].

    Among equal points, the first ones win. `count` must be at most M.
    """
    from scipy.spatial import cKDTree  # slow to import

    among = points if among is None else among
    # A tree cannot split equal points: each query would compare all of them.
    rows = np.lexsort(among.T)
    starts = np.append(True, (among[rows[1:]] != among[rows[:-1]]).any(axis=1))
    copies = np.arange(len(rows)) - np.flatnonzero(starts)[np.cumsum(starts) - 1]
    kept = np.sort(rows[copies < count])
    threads = torch.get_num_threads()
    distances, nearest = cKDTree(among[kept]).query(points, k=np.arange(1, count + 1), workers=threads)
    return distances, kept[nearest]
