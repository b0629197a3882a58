"""Distances of attributes against known changes and SciPy; 3D-Sinkhorn as published, blind spots included."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace

import numpy as np
import numpy.typing as npt
import pytest
from scipy.stats import wasserstein_distance

from keyss.core import Gaussians, UsageError
from keyss.lab import against_controls, attribute_distances, composite_score, distances, features, sinkhorn_3d
from lab.lifelike import (
    CHANGES,
    doubled_scales,
    lifelike,
    random_rotations,
    red_for_blue,
    rescaled_quaternions,
    some_transparent,
    stronger_harmonics,
    tripled_positions,
)

MODEL = lifelike(3000)


@pytest.mark.parametrize("change", CHANGES)
def test_each_change_moves_its_own_attribute(change: Callable[[Gaussians], Gaussians]) -> None:
    found = attribute_distances(MODEL, change(MODEL))
    moved = {name for name, value in found.items() if value > 1e-5}
    expected = CHANGES[change]
    assert moved == (expected | {"joint"} if expected else set())
    assert all(found[name] > 0.02 for name in expected)


def test_independent_samples_are_close() -> None:
    assert max(attribute_distances(MODEL, lifelike(3000, seed=1)).values()) < 0.02


@pytest.mark.parametrize("count", [3000, 1700])
@pytest.mark.parametrize("name", ["position", "opacity", "rotation"])
def test_axes_agree_with_scipy(count: int, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(distances, "SLICES", 0)
    other = lifelike(count, seed=1)
    columns = zip(features(MODEL)[name].T, features(other)[name].T, strict=True)
    expected = [
        wasserstein_distance(a, b) / np.subtract(*np.quantile(a, [0.95, 0.05], method="nearest"))
        for a, b in columns
    ]
    found = attribute_distances(MODEL, other)[name]
    assert found == pytest.approx(np.mean(expected), rel=1e-4)


def test_ratio_to_seed_to_seed_variation() -> None:
    plain = [lifelike(3000, seed) for seed in (1, 2, 3)]
    honest = against_controls(MODEL, plain, original=doubled_scales(MODEL))
    assert all(each.ratio is not None and 0.5 < each.ratio < 2 for each in honest.values())
    suspicious = against_controls(doubled_scales(MODEL), plain)
    assert (suspicious["scale"].ratio or 0) > 10
    assert honest["scale"].original == suspicious["scale"].ratio
    assert suspicious["scale"].original is None
    assert suspicious["opacity"] == replace(honest["opacity"], original=None)
    pairs = [(plain[0], plain[1]), (plain[0], plain[2]), (plain[1], plain[2])]
    control = np.mean([attribute_distances(*pair)["joint"] for pair in pairs])
    distance = np.mean([attribute_distances(each, MODEL)["joint"] for each in plain])
    joint = honest["joint"]
    assert (joint.distance, joint.control, joint.ratio) == pytest.approx(
        (distance, control, distance / control)
    )


def test_too_little_is_refused() -> None:
    with pytest.raises(UsageError, match="empty"):
        attribute_distances(MODEL, MODEL[:0])


LARGE = lifelike(10_000)
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
    changed = change(LARGE)
    found = sinkhorn_3d(LARGE, changed)
    lengths = {
        "opacity": lambda model: model.opacities,
        "rotation": lambda model: model.quats.norm(dim=1),
        "scale": lambda model: model.scales.norm(dim=1),
        "position": lambda model: model.means.norm(dim=1),
        "colour": lambda model: model.sh[:, 0].norm(dim=1),
    }
    for name, length in lengths.items():
        expected = _by_definition(length(LARGE).double().numpy(), length(changed).double().numpy())
        assert asdict(found)[name] == pytest.approx(expected, abs=1e-4), name
    assert found.sum == pytest.approx(sum(asdict(found)[name] for name in lengths))


@pytest.mark.parametrize(
    "change", [doubled_scales, random_rotations, tripled_positions, red_for_blue, stronger_harmonics]
)
def test_blind_to_visible_changes(change: Callable[[Gaussians], Gaussians]) -> None:
    same, changed = sinkhorn_3d(LARGE, LARGE), sinkhorn_3d(LARGE, change(LARGE))
    assert asdict(changed) == pytest.approx(asdict(same), abs=1e-5)


@pytest.mark.parametrize(
    ("cover", "secret", "distance", "score"),
    [(26.020, 26.138, 0.181, 42.717), (26.036, 26.113, 0.175, 43.008), (25.980, 26.427, 0.153, 44.389)],
)
def test_composite_score_of_the_paper(cover: float, secret: float, distance: float, score: float) -> None:
    assert composite_score(cover, secret, distance) == pytest.approx(score, abs=0.03)
