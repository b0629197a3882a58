"""Erasure coding, with `reedsolo` as the oracle."""

from __future__ import annotations

import numpy as np
import pytest
import reedsolo
from hypothesis import given, settings, strategies as st

from keyss.channels import reed_solomon


def _data(k: int, width: int = 5, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (k, width), dtype=np.uint8)


@pytest.mark.parametrize(("k", "n"), [(1, 2), (2, 3), (10, 20), (150, 255), (254, 255), (7, 255)])
def test_codewords_are_those_of_reedsolo(k: int, n: int) -> None:
    data, oracle = _data(k), reedsolo.RSCodec(n - k)
    coded = reed_solomon.encode(data, n)
    for column in range(data.shape[1]):
        assert bytes(oracle.encode(bytes(data[:, column]))) == coded[:, column].tobytes()
    lost = np.random.default_rng(1).permutation(n)[: n - k]
    damaged = coded.copy()
    damaged[lost] = 0
    theirs = oracle.decode(bytes(damaged[:, 0]), erase_pos=lost.tolist())[0]
    ours = reed_solomon.decode({i: coded[i] for i in range(n) if i not in set(lost.tolist())}, k, n)
    assert ours is not None
    assert bytes(theirs) == ours[:, 0].tobytes()


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 40), st.integers(0, 40), st.integers(0, 2**32 - 1))
def test_any_k_of_n_give_the_data_back_and_fewer_do_not(k: int, parity: int, seed: int) -> None:
    n = k + parity
    data = _data(k, seed=seed)
    coded = reed_solomon.encode(data, n)
    order = np.random.default_rng(seed).permutation(n)
    got = reed_solomon.decode({int(i): coded[i] for i in order[:k]}, k, n)
    assert got is not None
    assert np.array_equal(got, data)
    assert reed_solomon.decode({int(i): coded[i] for i in order[: k - 1]}, k, n) is None


@pytest.mark.parametrize(("k", "n"), [(0, 3), (4, 3), (10, 256)])
def test_sizes_out_of_range_are_refused(k: int, n: int) -> None:
    with pytest.raises(ValueError, match="expected"):
        reed_solomon.encode(_data(k), n)
