"""Entropy coding of integer tables."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from keyss.core import InputError
from keyss.methods.codec import entropy


@settings(max_examples=40, deadline=None)
@given(
    rows=st.integers(1, 60),
    columns=st.integers(1, 6),
    most=st.sampled_from([0, 1, 2, 7, 300, entropy.MAX_NUMBER]),
    seed=st.integers(0, 2**32 - 1),
)
def test_round_trip(rows: int, columns: int, most: int, seed: int) -> None:
    random = np.random.default_rng(seed)
    table = random.integers(-most, most + 1, (rows, columns))
    shares, groups = random.integers(0, 9, columns), random.integers(0, columns, columns)
    data = entropy.encode(table, shares, groups)
    assert (entropy.decode(data, rows, shares, groups) == table).all()
    for other in (data[:-1], data + b"\0", b""):
        with pytest.raises(InputError, match="length is wrong"):
            entropy.decode(other, rows, shares, groups)


def test_compression_rate() -> None:
    random = np.random.default_rng(0)
    rare = random.random((20_000, 1)) < 0.02
    zero, one = np.zeros(1, np.int64), np.array([8])
    bits = 8 * len(entropy.encode(rare.astype(np.int64), zero, zero))
    assert bits < 1.1 * 20_000 * (0.02 + -0.02 * np.log2(0.02) - 0.98 * np.log2(0.98))  # with a sign each
    walk = np.cumsum(random.integers(-3, 4, (20_000, 1)), axis=0)
    assert 8 * len(entropy.encode(walk, one, zero)) < 1.02 * 20_000 * np.log2(7)
