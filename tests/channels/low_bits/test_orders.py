"""Kernels that sort and compare, against numpy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from channels.low_bits.trained_like import trained_like
from keyss.channels.low_bits import kernels, salts
from keyss.channels.low_bits.bits import identities
from keyss.channels.low_bits.layout import SALTS
from keyss.channels.low_bits.multiples import repeated
from keyss.core import Gaussians

_WORDS = st.integers(0, 2**64 - 1)


@given(st.lists(_WORDS | st.sampled_from([0, 1, 2**63, 2**64 - 1]), max_size=300))
@settings(deadline=None)
def test_the_order_of_numbers(numbers: list[int]) -> None:
    values, rows = np.array(numbers, np.uint64), np.empty(len(numbers), np.int64)
    kernels.order(values, rows)
    assert rows.tolist() == np.argsort(values, kind="stable").tolist()


@pytest.mark.parametrize("count", [4095, 4096, 40_000])
def test_the_order_of_many_random_numbers(count: int) -> None:
    values = np.random.default_rng(count).integers(0, 2**64 - 1, count, dtype=np.uint64)
    rows = np.empty(count, np.int64)
    kernels.order(values, rows)
    assert rows.tolist() == np.argsort(values, kind="stable").tolist()


def test_numbers_that_occur_twice_among_many() -> None:
    random = np.random.default_rng(0)
    values = random.integers(0, 2**64 - 1, 50_000, dtype=np.uint64)
    assert not repeated(values).any()
    values[random.choice(50_000, 600, replace=False)] = np.tile(values[:300], 2)
    unique, inverse, times = np.unique(values, return_inverse=True, return_counts=True)
    assert len(unique) < 50_000
    assert repeated(values).tolist() == (times[inverse] > 1).tolist()


@pytest.mark.parametrize("looked_at", [SALTS + 1, 40, 700])
def test_salts_are_the_same_however_few_gaussians_are_looked_at_closely(
    looked_at: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = trained_like(3000, 4)
    grey = model.sh[:600].mean(dim=2, keepdim=True).expand(-1, -1, 3)  # the likeliest ones are coincidences
    model = Gaussians.cat([replace(model[:600], sh=10 * grey), model[600:]])
    names = identities(model)
    expected = salts.salt_rows(model, names)
    assert expected.min() >= 600
    monkeypatch.setattr(salts, "_LOOKED_AT", looked_at)
    assert salts.salt_rows(model, names).tolist() == expected.tolist()
