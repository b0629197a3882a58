"""Codewords, with the field arithmetic of `reedsolo` as the oracle."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import reedsolo
import torch
from hypothesis import given, settings, strategies as st

from keyss.channels.reed_solomon import Codewords
from keyss.core import InputError


@pytest.fixture(scope="module", autouse=True)
def _field() -> None:
    reedsolo.init_tables(prim=0x1100B, generator=2, c_exp=16)


WIDTH = 6


@cache
def points() -> list[int]:
    """All sums of a Cantor basis in the order of their binary numbers."""
    found, basis = [0], 1
    while len(found) < 1 << 13:
        found += [each ^ basis for each in found]
        basis = next(x for x in range(1 << 16) if reedsolo.gf_mul(x, x) ^ x == basis)
    return found


@pytest.mark.parametrize(("k", "n"), [(1, 2), (2, 3), (10, 20), (60, 90), (7, 255), (5, 513)])
def test_codewords_are_values_of_polynomials(k: int, n: int) -> None:
    coefficients = np.random.default_rng(k).integers(0, 1 << 16, (WIDTH // 2, k)).tolist()
    values = [[reedsolo.gf_poly_eval(coefficient, x) for coefficient in coefficients] for x in points()[:n]]
    expected = np.array(values, ">u2").view(np.uint8)
    assert np.array_equal(Codewords(1, n, k, WIDTH).encode(expected[:k].tobytes()), expected)


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 40), st.integers(0, 40), st.integers(0, 2**32 - 1))
def test_any_k_of_n_give_the_data_back_and_fewer_do_not(k: int, parity: int, seed: int) -> None:
    random, codewords = np.random.default_rng(seed), Codewords(1, k + parity, k, WIDTH)
    data = random.bytes(codewords.size)
    coded, order = codewords.encode(data), random.permutation(k + parity)
    assert codewords.decode(order[:k], coded[order[:k]]) == data
    with pytest.raises(InputError):
        codewords.decode(order[: k - 1], coded[order[: k - 1]])


@settings(max_examples=30, deadline=None)
@given(
    codewords=st.builds(
        lambda count, k, parity, symbols: Codewords(count, k + parity, k, 2 * symbols),
        *(st.integers(least, most) for least, most in ((1, 9), (1, 40), (0, 40), (1, 70))),
    ),
    seed=st.integers(0, 2**32 - 1),
)
def test_codewords_with_different_losses_on_one_thread_and_on_many(codewords: Codewords, seed: int) -> None:
    random = np.random.default_rng(seed)
    data = random.bytes(codewords.size)
    threads = torch.get_num_threads()
    coded = []
    try:
        for count in (1, 3):
            torch.set_num_threads(count)
            coded.append(codewords.encode(data))
            kept = [c + codewords.count * random.permutation(codewords.n) for c in range(codewords.count)]
            kept = [each[: random.integers(codewords.k, codewords.n + 1)] for each in kept]
            left = random.permutation(np.concatenate(kept))
            assert codewords.decode(left, coded[-1][left]) == data
    finally:
        torch.set_num_threads(threads)
    assert np.array_equal(*coded)


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 40), st.integers(0, 12), st.integers(0, 20), st.integers(0, 2**32 - 1))
def test_an_error_costs_two_shards(k: int, wrong: int, lost: int, seed: int) -> None:
    random, codewords = np.random.default_rng(seed), Codewords(1, k + 2 * wrong + lost, k, WIDTH)
    data = random.bytes(codewords.size)
    left = random.permutation(codewords.n)[lost:]
    rows = codewords.encode(data)[left]
    rows[:wrong] ^= random.integers(1, 256, (wrong, WIDTH), np.uint8)
    assert codewords.decode(left, rows, errors=True) == data


def test_long_codewords_with_losses_and_errors() -> None:
    random = np.random.default_rng(5)
    codewords = Codewords(1, 8192, 5895, 8)
    data = random.bytes(codewords.size)
    shards = codewords.encode(data)
    numbers = random.permutation(codewords.shards)[: round(0.75 * codewords.shards)]
    left = shards[numbers]
    left[:60] = random.integers(0, 256, (60, 8))
    assert codewords.decode(numbers, left) != data
    assert codewords.decode(numbers, left, errors=True) == data
    twice = np.concatenate([numbers, numbers[60:100]]), np.concatenate([left, left[:40]])
    assert codewords.decode(*twice, errors=True) == data  # both of two that differ are left out
    with pytest.raises(InputError, match=r"4,500 of 8,192 shards are left, at least [\d,]+ needed"):
        codewords.decode(numbers[:4500], left[:4500], errors=True)


@pytest.mark.parametrize(("k", "n"), [(0, 3), (4, 3), (10, 8193)])
def test_sizes_out_of_range_are_refused(k: int, n: int) -> None:
    with pytest.raises(ValueError, match="impossible"):
        Codewords(1, n, k, 8)
    with pytest.raises(ValueError, match="impossible"):
        Codewords(1, 3, 2, 7)
