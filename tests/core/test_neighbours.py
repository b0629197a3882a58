"""Nearest neighbours, also of repeated points."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from keyss.core.neighbours import nearest_neighbours


@pytest.mark.parametrize("copies", [1, 3, 40])
@pytest.mark.parametrize("count", [1, 4])
def test_matches_brute_force(copies: int, count: int) -> None:
    rng = np.random.default_rng(copies)
    points = rng.permutation(rng.normal(size=(30, 3)).repeat(copies, axis=0))
    distances, indices = nearest_neighbours(points, count)
    assert np.allclose(distances, np.sort(cdist(points, points), axis=1)[:, :count], atol=1e-12)
    apart = np.linalg.norm(points[:, None] - points[indices], axis=2)
    assert np.allclose(apart, distances, atol=1e-12)
    assert all(len(set(row)) == count for row in indices.tolist())


def test_separate_query_points() -> None:
    points, others = np.array([[0.0], [10.0]]), np.array([[9.0], [1.0], [1.0], [9.5]])
    distances, indices = nearest_neighbours(points, 2, others)
    assert distances.tolist() == [[1, 1], [0.5, 1]]
    assert sorted(indices[0].tolist()) == [1, 2]
    assert indices[1].tolist() == [3, 0]
