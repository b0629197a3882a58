"""Nothing but what was encrypted is accepted."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, strategies as st

from channels.colours.made import cover, embed, extract
from keyss.channels.colours import header, reading
from keyss.channels.colours.payload import OVERHEAD, decrypt_payload, encrypt_payload
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
    stego = embed(cover(6000), [("a", b"x")], entropy=bytes(32))
    sizes, decrypt = [], reading.decrypt_payload

    def counted(data_key: bytes, encrypted: bytes) -> bytes | None:
        sizes.append(len(encrypted))
        decrypt(data_key, encrypted)
        return None  # so that all is tried that ever is

    monkeypatch.setattr(reading, "decrypt_payload", counted)
    for name in "ab":
        with pytest.raises(Exception, match="the key is right" if name == "a" else "opens nothing"):
            extract(stego, name)
    assert 1 <= len(sizes) <= 4
    largest = max(header.bucket_bytes(bucket) for bucket in range(256))
    assert math.log2(len(sizes) * 8 * (largest / 16) / 2**106) < -64
    assert len(encrypt_payload(KEY, b"", 64)) - 64 == 0
    assert OVERHEAD >= TAG + 4


def test_random_keys_open_nothing_and_right_ones_their_own() -> None:
    stego = embed(cover(6000), [("a", b"x")], entropy=bytes(32))
    assert extract(stego, "a") == b"x"
    for number in np.random.default_rng(0).integers(0, 2**32, 8):
        with pytest.raises(WrongKeyError):
            extract(stego, str(number))
