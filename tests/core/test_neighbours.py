"""Nearest neighbours of points, many of which may be equal."""

from __future__ import annotations

import time

import numpy as np
import pytest
import torch
from scipy.spatial.distance import cdist

from keyss.channels.quiet.fields import carrying
from keyss.channels.quiet.kept import changeable
from keyss.core import Gaussians
from keyss.core.neighbours import nearest_neighbours
from keyss.files.formats.spz import SpzCodes
from keyss.fitting.parameters import initial_gaussians


@pytest.mark.parametrize("copies", [1, 3, 40])
@pytest.mark.parametrize("count", [1, 4])
def test_distances_are_those_of_all_pairs(copies: int, count: int) -> None:
    rng = np.random.default_rng(copies)
    points = rng.permutation(rng.normal(size=(30, 3)).repeat(copies, axis=0))
    distances, indices = nearest_neighbours(points, count)
    assert np.allclose(distances, np.sort(cdist(points, points), axis=1)[:, :count], atol=1e-12)
    apart = np.linalg.norm(points[:, None] - points[indices], axis=2)
    assert np.allclose(apart, distances, atol=1e-12)
    assert all(len(set(row)) == count for row in indices.tolist())


def test_others_than_the_points_themselves() -> None:
    points, others = np.array([[0.0], [10.0]]), np.array([[9.0], [1.0], [1.0], [9.5]])
    distances, indices = nearest_neighbours(points, 2, others)
    assert distances.tolist() == [[1, 1], [0.5, 1]]
    assert sorted(indices[0].tolist()) == [1, 2]
    assert indices[1].tolist() == [3, 0]


def test_equal_points_do_not_take_quadratic_time() -> None:
    """In a .spz, 131,072 equal Gaussians take 3 kB."""
    count = 1 << 17
    points = torch.zeros(count, 3)
    codes = SpzCodes.of(Gaussians(points, torch.ones(count, 4), points, points[:, 0], points[:, None]))
    start = time.process_time()
    initial_gaussians(points, points.byte(), 0, count, torch.Generator())
    changeable(codes, carrying(codes).fields(codes), bytes(32))
    assert time.process_time() - start < 10  # comparing all pairs takes many times as long
