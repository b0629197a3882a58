"""Each change moves its own attribute, by known amounts, and chance is told apart."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import wasserstein_distance

from keyss.core import Gaussians, UsageError
from keyss.lab import against_controls, attribute_distances, distances, features
from lab.lifelike import CHANGES, doubled_scales, lifelike, stronger_harmonics

MODEL = lifelike(3000)


@pytest.mark.parametrize("change", CHANGES)
def test_a_change_moves_its_attribute_and_no_other(change: Callable[[Gaussians], Gaussians]) -> None:
    found = attribute_distances(MODEL, change(MODEL))
    moved = {name for name, value in found.items() if value > 1e-5}
    expected = CHANGES[change]
    assert moved == (expected | {"joint"} if expected else set())
    assert all(found[name] > 0.02 for name in expected)


def test_a_model_is_at_no_distance_from_itself_nor_from_itself_twice() -> None:
    assert set(attribute_distances(MODEL, MODEL).values()) == {0.0}
    twice = Gaussians.cat([MODEL, MODEL])
    assert max(attribute_distances(MODEL, twice).values()) < 1e-5


def test_independent_samples_are_much_nearer_than_any_change() -> None:
    assert max(attribute_distances(MODEL, lifelike(3000, seed=1)).values()) < 0.02


def test_known_amounts() -> None:
    """A shift by d is d / range; a normal number times 5 is 4 E|x| over the range of a normal number."""
    lower, upper = np.quantile(MODEL.opacity_logits.numpy(), [0.05, 0.95])
    shifted = replace(MODEL, opacity_logits=MODEL.opacity_logits + 0.5)
    assert attribute_distances(MODEL, shifted)["opacity"] == pytest.approx(0.5 / (upper - lower), rel=0.01)
    expected = 4 * math.sqrt(2 / math.pi) / (2 * 1.6449)
    found = attribute_distances(MODEL, stronger_harmonics(MODEL))["harmonics"]
    assert found == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize("count", [3000, 1700])
@pytest.mark.parametrize("name", ["position", "opacity", "rotation"])
def test_along_axes_they_are_scipys(count: int, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(distances, "SLICES", 0)
    other = lifelike(count, seed=1)
    columns = zip(features(MODEL)[name].T, features(other)[name].T, strict=True)
    expected = [
        wasserstein_distance(a, b) / np.subtract(*np.quantile(a, [0.95, 0.05], method="nearest"))
        for a, b in columns
    ]
    found = attribute_distances(MODEL, other)[name]
    assert found == pytest.approx(np.mean(expected), rel=1e-4)


def test_slices_see_what_axes_do_not(monkeypatch: pytest.MonkeyPatch) -> None:
    """Correlated colours and the same colours, each channel shuffled."""
    generator = torch.Generator().manual_seed(0)
    grey = torch.randn(3000, 1, 1, generator=generator).expand(-1, 16, 3).clone()
    mixed = grey.clone()
    for channel in range(3):
        mixed[:, 0, channel] = grey[torch.randperm(3000, generator=generator), 0, channel]
    one, two = replace(MODEL, sh=grey), replace(MODEL, sh=mixed)
    assert attribute_distances(one, two)["colour"] > 0.05
    monkeypatch.setattr(distances, "SLICES", 0)
    assert attribute_distances(one, two)["colour"] < 1e-6


def test_what_is_constant_or_not_finite_gives_finite_numbers() -> None:
    flat = MODEL.with_sh_degree(0)
    assert attribute_distances(flat, flat.with_sh_degree(3))["harmonics"] == 0
    assert 0 < attribute_distances(flat, MODEL)["harmonics"] < 1
    opaque = replace(MODEL, opacity_logits=torch.full((3000,), math.inf))
    assert attribute_distances(opaque, opaque)["opacity"] == 0
    assert attribute_distances(opaque, MODEL)["opacity"] > 0.5
    broken = MODEL.opacity_logits.clone()
    broken[:3] = torch.tensor([math.nan, math.inf, -math.inf])
    found = attribute_distances(MODEL, replace(MODEL, opacity_logits=broken, quats=0 * MODEL.quats))
    assert all(map(math.isfinite, found.values()))
    assert 0 < found["opacity"] < 0.01


def test_large_models_are_thinned_by_the_seed(monkeypatch: pytest.MonkeyPatch) -> None:
    exact = attribute_distances(MODEL, doubled_scales(MODEL))
    monkeypatch.setattr(distances, "MAX_GAUSSIANS", 1000)
    runs = [attribute_distances(MODEL, doubled_scales(MODEL), seed=seed) for seed in (4, 4, 5)]
    assert runs[0] == runs[1] != runs[2]
    assert runs[0]["scale"] == pytest.approx(exact["scale"], rel=0.1)


def test_the_seed_to_seed_variation_is_what_another_seed_gives() -> None:
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


def test_without_a_spread_there_is_no_ratio() -> None:
    found = against_controls(doubled_scales(MODEL), [MODEL, MODEL])["scale"]
    assert found.distance > 0.1
    assert (found.control, found.ratio) == (0, None)


def test_too_little_is_refused() -> None:
    with pytest.raises(UsageError, match="empty"):
        attribute_distances(MODEL, MODEL[:0])
    with pytest.raises(UsageError, match="two control models"):
        against_controls(MODEL, [MODEL])
