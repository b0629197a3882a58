"""Every detector finds its own kind of weakness, and nothing in plain models."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from keyss.core import Gaussians
from keyss.lab import judge, stealth_statistics
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


def z(name: str, model: Gaussians, other: Gaussians) -> float:
    """Standard errors between a statistic of two models."""
    one, two = stealth_statistics(model)[name], stealth_statistics(other)[name]
    assert one.error is not None
    assert two.error is not None
    return abs(one.value - two.value) / (one.error**2 + two.error**2) ** 0.5


def p(name: str, model: Gaussians) -> float:
    found = stealth_statistics(model)[name].p
    assert found is not None
    return found


@pytest.mark.parametrize(
    ("name", "natural"),
    [
        ("bits: ones in bits 1-3, tiny harmonics", plain_rounded),
        ("bits: zeros above a zero, tiny harmonics", plain_rounded),
        ("bits: 4 zeros at the end, tiny harmonics", plain_rounded),
        ("agreement: close low bits, channels", lambda seed: grey(plain(seed))),
        ("agreement: near misses, channels", lambda seed: grey(plain(seed))),
        ("agreement: equal low bits, neighbours", lambda seed: with_siblings(plain(seed))),
        ("agreement: near misses, sharers", lambda seed: with_siblings(plain(seed))),
        ("invariants: quaternions of unit length", lambda seed: normalised(plain(seed))),
        ("invariants: quaternions of nearly unit length", lambda seed: normalised(plain(seed))),
        ("invariants: repeated values, sh3", lambda seed: with_siblings(plain(seed))),
    ],
)
def test_new_low_bits_are_detected_where_old_ones_were_not_random(
    name: str, natural: Callable[[int], Gaussians]
) -> None:
    model = natural(1)
    stego = overwritten(model, bits=8)
    if "sharers" in name:
        # Siblings share constant colours, which stay as they are; the rest is near now, not equal.
        assert stealth_statistics(stego)[name].value > 0.1
    assert z(name, model, stego) > 5
    assert z(name, model, natural(2)) < 4.5


def test_random_low_bits_may_be_replaced() -> None:
    """The control: the same change where bits were random before."""
    model = plain(1)
    before, after = stealth_statistics(model), stealth_statistics(overwritten(model))
    for name in before:
        one, two = before[name], after[name]
        if one.error:
            assert abs(one.value - two.value) < 5 * (one.error**2 + (two.error or 0) ** 2) ** 0.5, name


def test_exact_nulls() -> None:
    """Small p-values are as frequent as expected."""
    values = [
        each.p
        for seed in range(4)
        for name, each in stealth_statistics(plain(seed)).items()
        if each.p is not None and name.startswith("bits") and "position" not in name
    ]
    assert len(values) > 200
    assert sum(value < 0.05 for value in values) / len(values) < 0.09
    assert min(values) > 0.01 / len(values)


def test_bands_of_invisible_gaussians_are_counted() -> None:
    one, two = banded(plain(1), plain(2)), banded(plain(1), plain(2), plain(3))
    assert stealth_statistics(plain(1))["opacities: share of opacities, invisible"].value == 0
    assert stealth_statistics(one)["opacities: share of opacities, invisible"].value > 0.4
    controls = [plain(3, 400), plain(4, 400)]
    assert [judge(model, controls).invisible_groups for model in (plain(1), one, two)] == [0, 1, 2]


def test_order_of_rows() -> None:
    name = "order: row and size, correlation"
    assert p(name, plain(1)) < 1e-20
    assert p(name, shuffled(plain(1))) > 1e-4
    appended = "order: halves of rows, opacity"
    assert p(appended, banded(plain(1), plain(2))) < 1e-20
    assert p(appended, plain(1)) > 1e-4


@pytest.mark.parametrize("count", [1, 2, 40, 150])
def test_small_models_have_fewer_statistics(count: int) -> None:
    some, every = stealth_statistics(plain(1)[:count]), stealth_statistics(plain(1))
    assert set(some) < set(every)


def test_frozen_values_of_clones() -> None:
    """Harmonics of one channel, and saturated opacities, that differ after careless embedding alone."""
    model = plain(1)
    model.opacity_logits[:200] = 17.3
    model.means[:200] = model.means[:1] + 0.001 * model.means[:200]
    frozen, overwritten_too = (stealth_statistics(each) for each in (model, overwritten(model, bits=8)))
    name = "coincidences: saturated, opacity"
    assert frozen[name].value == 2**8
    assert overwritten_too[name].value < 10
