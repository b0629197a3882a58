"""Every detector finds its own kind of weakness, and nothing in plain models."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import pytest
from scipy.stats import binom

from keyss.core import Gaussians
from keyss.lab import stealth_statistics
from keyss.lab.stealth.attributes import invisible_modes
from keyss.lab.stealth.statistic import Statistic
from lab.stealth.careless import (
    banded,
    grey,
    normalised,
    overwritten,
    plain,
    plain_rounded,
    shuffled,
    with_siblings,
)
from methods.carry.carried import embed

ALARM = 1e-6  # probability of a false alarm


def z(one: Statistic, two: Statistic) -> float:
    """Standard errors between the values of one statistic."""
    assert one.error is not None
    assert two.error is not None
    return abs(one.value - two.value) / (one.error**2 + two.error**2) ** 0.5


@cache
def of_plain(seed: int) -> dict[str, Statistic]:
    return stealth_statistics(plain(seed))


@pytest.mark.parametrize(
    ("natural", "names"),
    [
        (
            plain_rounded,
            (
                "bits: ones in bits 1-3, tiny harmonics",
                "bits: zeros above a zero, tiny harmonics",
                "bits: 4 zeros at the end, tiny harmonics",
            ),
        ),
        (
            lambda seed: grey(plain(seed)),
            ("agreement: close low bits, channels", "agreement: near misses, channels"),
        ),
        (
            lambda seed: with_siblings(plain(seed)),
            (
                "agreement: equal low bits, neighbours",
                "agreement: near misses, sharers",
                "invariants: repeated values, sh3",
            ),
        ),
        (
            lambda seed: normalised(plain(seed)),
            ("invariants: quaternions of unit length", "invariants: quaternions of nearly unit length"),
        ),
    ],
    ids=["rounded", "grey", "siblings", "normalised"],
)
def test_overwritten_relations_are_detected(
    natural: Callable[[int], Gaussians], names: tuple[str, ...]
) -> None:
    model = natural(1)
    before, other, stego = map(stealth_statistics, (model, natural(2), overwritten(model, bits=8)))
    for name in names:
        if "sharers" in name:
            # Siblings share constant colours, which embedding keeps.
            assert stego[name].value > 0.1
        assert z(before[name], stego[name]) > 5, name
        assert z(before[name], other[name]) < 4.5, name


@pytest.mark.parametrize("change", [overwritten, lambda model: embed(model, [("a key", plain(2, 800))])])
def test_new_random_bits_are_not_detected(change: Callable[[Gaussians], Gaussians]) -> None:
    """The control: careless changes, and a hidden model, where bits were random before."""
    before, after = of_plain(1), stealth_statistics(change(plain(1)))
    for name in before:
        one, two = before[name], after[name]
        if one.error:
            assert abs(one.value - two.value) < 5 * (one.error**2 + (two.error or 0) ** 2) ** 0.5, name


def test_exact_nulls() -> None:
    """Small p-values are as frequent as expected."""
    values = [
        each.p
        for seed in range(4)
        for name, each in of_plain(seed).items()
        if each.p is not None and name.startswith("bits") and "position" not in name
    ]
    assert len(values) > 200
    assert sum(value < 0.05 for value in values) < binom.isf(ALARM, len(values), 0.05)
    assert min(values) > ALARM / len(values)


def test_bands_of_invisible_gaussians_are_counted() -> None:
    one, two = banded(plain(1), plain(2)), banded(plain(1), plain(2), plain(3))
    assert of_plain(1)["opacities: share of opacities, invisible"].value == 0
    assert stealth_statistics(one)["opacities: share of opacities, invisible"].value > 0.4
    assert [len(invisible_modes(model)) for model in (plain(1), one, two)] == [0, 1, 2]


def test_order_of_rows() -> None:
    own, mixed, appended = (
        of_plain(1),
        *map(stealth_statistics, (shuffled(plain(1)), banded(plain(1), plain(2)))),
    )
    name = "order: row and size, correlation"
    assert own[name].p < 1e-20
    assert mixed[name].p > 1e-4
    name = "order: halves of rows, opacity"
    assert appended[name].p < 1e-20
    assert own[name].p > 1e-4


@pytest.mark.parametrize("count", [1, 2, 40, 150])
def test_small_models_have_fewer_statistics(count: int) -> None:
    assert set(stealth_statistics(plain(1)[:count])) < set(of_plain(1))


def test_frozen_values_of_clones() -> None:
    """Harmonics of one channel, and saturated opacities, that differ after careless embedding alone."""
    model = plain(1)
    model.opacity_logits[:200] = 17.3
    model.means[:200] = model.means[:1] + 0.001 * model.means[:200]
    frozen, overwritten_too = (stealth_statistics(each) for each in (model, overwritten(model, bits=8)))
    name = "coincidences: saturated, opacity"
    assert frozen[name].value == 2**8
    assert overwritten_too[name].value < 10
