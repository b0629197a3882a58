"""3D-Sinkhorn as in the paper, blind spots included."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict

import numpy as np
import numpy.typing as npt
import pytest

from keyss.core import Gaussians
from keyss.lab import composite_score, sinkhorn_3d
from lab.lifelike import (
    doubled_scales,
    lifelike,
    random_rotations,
    red_for_blue,
    rescaled_quaternions,
    some_transparent,
    stronger_harmonics,
    tripled_positions,
)

MODEL = lifelike(10_000)
Doubles = npt.NDArray[np.float64]


def _by_definition(original: Doubles, other: Doubles) -> float:
    """Cost of the plan u K v with the right margins, where empty bins have u or v = 0 (Cuturi 2013)."""
    original, other = original / original.max(), other / other.max()
    ours, edges = np.histogram(original, 100)
    theirs, _ = np.histogram(other, edges)
    centres = (edges[1:] + edges[:-1]) / 2
    cost = np.abs(centres[:, None] - centres)
    kernel, v = np.exp(-cost / 0.01), np.ones(100)
    for _ in range(5000):
        u = ours / ours.sum() / (kernel @ v)
        v = theirs / theirs.sum() / (kernel.T @ u)
    return float(u @ (kernel * cost) @ v)


@pytest.mark.parametrize("change", [some_transparent, rescaled_quaternions])
def test_distance_is_the_cost_of_the_optimal_plan(change: Callable[[Gaussians], Gaussians]) -> None:
    changed = change(MODEL)
    found = sinkhorn_3d(MODEL, changed)
    lengths = {
        "opacity": lambda model: model.opacities,
        "rotation": lambda model: model.quats.norm(dim=1),
        "scale": lambda model: model.scales.norm(dim=1),
        "position": lambda model: model.means.norm(dim=1),
        "colour": lambda model: model.sh[:, 0].norm(dim=1),
    }
    for name, length in lengths.items():
        expected = _by_definition(length(MODEL).double().numpy(), length(changed).double().numpy())
        assert asdict(found)[name] == pytest.approx(expected, abs=1e-4), name
    assert found.sum == pytest.approx(sum(asdict(found)[name] for name in lengths))


@pytest.mark.parametrize(
    "change", [doubled_scales, random_rotations, tripled_positions, red_for_blue, stronger_harmonics]
)
def test_blind_to_visible_changes(change: Callable[[Gaussians], Gaussians]) -> None:
    same, changed = sinkhorn_3d(MODEL, MODEL), sinkhorn_3d(MODEL, change(MODEL))
    assert asdict(changed) == pytest.approx(asdict(same), abs=1e-5)


@pytest.mark.parametrize(
    ("cover", "secret", "distance", "score"),
    [(26.020, 26.138, 0.181, 42.717), (26.036, 26.113, 0.175, 43.008), (25.980, 26.427, 0.153, 44.389)],
)
def test_composite_score_of_the_paper(cover: float, secret: float, distance: float, score: float) -> None:
    assert composite_score(cover, secret, distance) == pytest.approx(score, abs=0.03)
