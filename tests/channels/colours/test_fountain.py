"""The code: against arithmetic by hand, and through channels of known capacity."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from keyss.channels import Fountain
from keyss.channels.colours.fountain import equations
from keyss.channels.mixing import mixed


def _random_bits(count: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 2, count).astype(np.uint8)


def _seeds(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 2**63, count).astype(np.uint64)


def _noisy(code: np.ndarray, errors: float, seed: int) -> np.ndarray:
    """Ratios as a binary symmetric channel gives them."""
    flipped = code ^ (np.random.default_rng(seed).random(len(code)) < errors)
    return (math.log((1 - errors) / errors) * (1 - 2.0 * flipped)).astype(np.float32)


def test_mixed_is_splitmix64() -> None:
    """The first outputs of the reference implementation (Vigna) seeded with 1234567."""
    states = np.uint64(1234567) + np.arange(3, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    assert mixed(states).tolist() == [6457827717110365317, 3203168211198807973, 9817491932198370423]


def test_code_bits_are_the_sums_that_the_equations_say() -> None:
    code, data, seeds = Fountain(40), _random_bits(40, 0), _seeds(200)
    bits = code.encode(data, seeds)
    starts, members = equations(seeds, code.length)
    # The intermediate bits follow from code bits of one member.
    known = {int(members[starts[i]]): int(bits[i]) for i in range(200) if starts[i + 1] - starts[i] == 1}
    whole = [i for i in range(200) if all(int(m) in known for m in members[starts[i] : starts[i + 1]])]
    assert len(whole) >= len(known) > 0
    for i in whole:
        assert bits[i] == sum(known[int(m)] for m in members[starts[i] : starts[i + 1]]) % 2
    assert all(known[index] == data[index] for index in known if index < 40)


def test_a_member_is_chosen_evenly_and_the_degrees_are_the_stated_ones() -> None:
    starts, members = equations(_seeds(40_000), 1000)
    degrees = np.diff(starts)
    assert np.mean(degrees == 2) == pytest.approx(0.486, abs=0.01)
    assert np.mean(degrees == 65) == pytest.approx(0.031, abs=0.004)
    counts = np.bincount(members, minlength=1000)
    assert counts.std() < 1.15 * math.sqrt(counts.mean())


@settings(max_examples=30, deadline=None)
@given(size=st.integers(100, 700), seed=st.integers(0, 1000))
def test_any_data_come_back_from_twice_as_many_bits_with_errors(size: int, seed: int) -> None:
    """2 % of errors leave a capacity of 0.86; the shortest codes need most beside it."""
    code, data, seeds = Fountain(size), _random_bits(size, seed), _seeds(3 * size + 200, seed)
    found, _ = code.decode(seeds, _noisy(code.encode(data, seeds), 0.02, seed), 60)
    assert (found == data).all()


@pytest.mark.parametrize("errors", [0.02, 0.11])
def test_a_long_code_needs_a_quarter_more_than_capacity(errors: float) -> None:
    size = 8000
    capacity = 1 + errors * math.log2(errors) + (1 - errors) * math.log2(1 - errors)
    code, data, seeds = Fountain(size), _random_bits(size, 1), _seeds(int(1.25 * size / capacity))
    found, done = code.decode(seeds, _noisy(code.encode(data, seeds), errors, 2), 60)
    assert done
    assert (found == data).all()


def test_too_few_bits_are_not_taken_for_enough() -> None:
    code, data, seeds = Fountain(800), _random_bits(800, 1), _seeds(700)
    _, done = code.decode(seeds, _noisy(code.encode(data, seeds), 0.02, 2), 30)
    assert not done


def test_bits_of_the_wrong_number_are_refused() -> None:
    with pytest.raises(ValueError, match="expected 40 bits"):
        Fountain(40).encode(_random_bits(41, 0), _seeds(9))
