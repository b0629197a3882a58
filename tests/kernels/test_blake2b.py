"""BLAKE2b of rows against the standard library."""

from __future__ import annotations

from hashlib import blake2b

import numpy as np
from hypothesis import given, settings, strategies as st

from keyss.kernels.blake2b import blake2b_rows


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 5), st.integers(1, 100), st.binary(max_size=16), st.integers(0, 2**32 - 1))
def test_hashes_of_rows(count: int, width: int, person: bytes, seed: int) -> None:
    rows = np.random.default_rng(seed).integers(0, 1 << 32, (count, width)).astype("<u4")
    expected = [blake2b(row.tobytes(), digest_size=16, person=person).digest() for row in rows]
    assert [row.tobytes() for row in blake2b_rows(rows, person)] == expected
