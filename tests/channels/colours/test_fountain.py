"""The code: against arithmetic by hand, and through channels of known capacity."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from keyss.channels import Fountain
from keyss.channels.mixing import mix


def _random_bits(count: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 2, count).astype(np.uint8)


def _seeds(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 2**63, count).astype(np.uint64)


def _noisy(code: np.ndarray, errors: float, seed: int) -> np.ndarray:
    """P(0) - P(1) as a binary symmetric channel gives them."""
    flipped = code ^ (np.random.default_rng(seed).random(len(code)) < errors)
    return (1 - 2 * errors) * (1 - 2.0 * flipped)


def test_mix_is_splitmix64() -> None:
    """The first outputs of the reference implementation (Vigna) seeded with 1234567."""
    states = np.uint64(1234567) + np.arange(3, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    assert mix(states).tolist() == [6457827717110365317, 3203168211198807973, 9817491932198370423]


def test_the_code_is_linear() -> None:
    code, seeds = Fountain(1000), _seeds(20_000)
    one, other = _random_bits(1000, 0), _random_bits(1000, 1)
    sums = code.encode(one, seeds) ^ code.encode(other, seeds)
    assert np.array_equal(code.encode(one ^ other, seeds), sums)


@settings(max_examples=30, deadline=None)
@given(size=st.integers(100, 700), seed=st.integers(0, 1000))
def test_any_data_come_back_from_twice_as_many_bits_with_errors(size: int, seed: int) -> None:
    """2 % of errors leave a capacity of 0.86; the shortest codes need most beside it."""
    code, data, seeds = Fountain(size), _random_bits(size, seed), _seeds(3 * size + 200, seed)
    found = code.decode(seeds, _noisy(code.encode(data, seeds), 0.02, seed))
    assert (found == data).all()


@pytest.mark.parametrize("errors", [0.02, 0.11])
def test_a_long_code_needs_a_quarter_more_than_capacity(errors: float) -> None:
    size = 8000
    capacity = 1 + errors * math.log2(errors) + (1 - errors) * math.log2(1 - errors)
    code, data, seeds = Fountain(size), _random_bits(size, 1), _seeds(int(1.25 * size / capacity))
    found = code.decode(seeds, _noisy(code.encode(data, seeds), errors, 2))
    assert (found == data).all()
