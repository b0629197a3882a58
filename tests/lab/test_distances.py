"""Distances of attributes against known changes and SciPy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import wasserstein_distance

from keyss.core import Gaussians, UsageError
from keyss.lab import against_controls, attribute_distances, distances, features
from lab.lifelike import CHANGES, doubled_scales, lifelike

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
