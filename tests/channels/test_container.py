"""What all channels share: sealed payloads, parameters, and shares of a capacity."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from keyss.channels import Capacity, Codewords, Parameters, Payload, container, seal, sealed_size, unseal
from keyss.core import InputError, KeyssWarning

KEY = bytes(range(16))
PAYLOADS = st.builds(Payload, st.text("abc-1", min_size=1, max_size=15), st.binary(max_size=300))


@settings(max_examples=30, deadline=None)
@given(payload=PAYLOADS, record=st.binary(max_size=200), more=st.integers(0, 50))
def test_sealed_payload_opens(payload: Payload, record: bytes, more: int) -> None:
    size = sealed_size(payload, len(record)) + more
    sealed = seal(KEY, payload, size, record)
    assert len(sealed) == size
    assert unseal(KEY, sealed, len(record)) == (record, payload)
    with pytest.raises(InputError, match="damaged"):
        unseal(KEY[::-1], sealed, len(record))


def test_every_byte_is_authenticated() -> None:
    payload, record = Payload("carry", b"data"), bytes(36)
    sealed = seal(KEY, payload, sealed_size(payload, 36) + 9, record)
    for at in range(len(sealed)):
        changed = bytearray(sealed)
        changed[at] ^= 1
        with pytest.raises(InputError, match="damaged"):
            unseal(KEY, bytes(changed), 36)
    with pytest.raises(InputError, match="damaged"):
        unseal(KEY, sealed[:30], 36)


def test_false_shards_are_found_by_authentication() -> None:
    code, payload = Codewords(2, 40, 20, 8), Payload("carry", b"data" * 20)
    shards = code.encode(seal(KEY, payload, code.size, bytes(36)))
    shards[[1, 30, 50]] ^= 1
    kept = np.random.default_rng(0).permutation(code.shards)[:60]
    assert container.unseal_shards(KEY, code, kept, shards[kept], 36) == (bytes(36), payload)


def test_parameters_open_with_their_data_key_only() -> None:
    parameters = Parameters(8, 2**32 - 1, 2**16 - 1, 3)
    packed = parameters.pack(KEY)
    assert len(packed) == container.PARAMETER_BYTES
    assert Parameters.unpack(packed, KEY) == parameters
    assert Parameters.unpack(packed, KEY[::-1]) is None


@given(needed=st.lists(st.integers(0, 1200), min_size=1, max_size=5))
def test_limits_do_not_depend_on_others_unless_it_warns(needed: list[int]) -> None:
    shares = [(0.25, 300), (0.5, 600), (1.0, 1100)]
    capacity = Capacity.of_sealed(100, shares, lambda count: 1100 // count)
    limits, alone = capacity.limits(needed), [capacity.limits([size])[0] for size in needed]
    assert all(limit in (200, 500, 1000) for limit in alone)
    if limits != alone:
        assert limits == [max(0, 1100 // len(needed) - 100)] * len(needed)
    if any(limit < min(size, most) for size, limit, most in zip(needed, limits, alone, strict=True)):
        with pytest.warns(KeyssWarning, match="can notice"):
            capacity.limits(needed, warn=True)
