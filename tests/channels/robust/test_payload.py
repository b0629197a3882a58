"""Nothing but what was encrypted is accepted."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from channels.robust.made import cover, key
from keyss.channels.robust import RobustCover, extract, reading
from keyss.channels.robust.header import bucket_bytes
from keyss.channels.robust.payload import OVERHEAD, decrypt_payload, encrypt_payload
from keyss.core import WrongKeyError

KEY = bytes(range(32))
TAG = 16  # bytes, of Poly1305


@given(st.binary(max_size=40), st.integers(0, 8 * 64 - 1))
def test_one_wrong_bit_anywhere_is_noticed(payload: bytes, bit: int) -> None:
    encrypted = bytearray(encrypt_payload(KEY, payload, 64))
    assert decrypt_payload(KEY, bytes(encrypted)) == payload
    encrypted[bit // 8] ^= 1 << bit % 8
    assert decrypt_payload(KEY, bytes(encrypted)) is None


@given(st.binary(min_size=TAG, max_size=200))
def test_what_nobody_encrypted_is_refused(encrypted: bytes) -> None:
    assert decrypt_payload(KEY, encrypted) is None


def test_false_acceptance_is_rarer_than_two_to_the_minus_64(monkeypatch: pytest.MonkeyPatch) -> None:
    """By the bound of RFC 8439's Poly1305, 8 blocks / 2^106 for each forgery that is tried, for the largest
    payload there can be, and as often as a reader tries to decrypt.
    """
    stego = RobustCover.of(cover(6000)).embed([(key("a"), b"x")], strength=45.0, entropy=bytes(32))
    sizes, decrypt = [], reading.decrypt_payload

    def counted(data_key: bytes, encrypted: bytes) -> bytes | None:
        sizes.append(len(encrypted))
        decrypt(data_key, encrypted)
        return None  # so that all is tried that ever is

    monkeypatch.setattr(reading, "decrypt_payload", counted)
    for name in "ab":
        with pytest.raises(Exception, match="the key is right" if name == "a" else "opens nothing"):
            extract(stego, key(name))
    assert 1 <= len(sizes) <= 4
    largest = max(bucket_bytes(bucket) for bucket in range(256))
    assert math.log2(len(sizes) * 8 * (largest / 16) / 2**106) < -64
    assert len(encrypt_payload(KEY, b"", 64)) - 64 == 0
    assert OVERHEAD >= TAG + 4


def test_random_keys_open_nothing_and_right_ones_their_own() -> None:
    stego = RobustCover.of(cover(6000)).embed([(key("a"), b"x")], strength=45.0, entropy=bytes(32))
    assert extract(stego, key("a")) == b"x"
    for number in np.random.default_rng(0).integers(0, 2**32, 8):
        with pytest.raises(WrongKeyError):
            extract(stego, key(str(number)))
