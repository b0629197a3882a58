"""Only what was encrypted for a key is accepted."""

from __future__ import annotations

import math

import pytest

from channels.colours.made import cover, embed, extract
from keyss.channels.colours import header, reading
from keyss.core import InputError


def test_false_acceptance_is_rarer_than_two_to_the_minus_64(monkeypatch: pytest.MonkeyPatch) -> None:
    """By the bound of RFC 8439's Poly1305, 8 blocks / 2^106 for each forgery that is tried, for the largest
    payload there can be, and as often as a reader tries to decrypt.
    """
    stego = embed(cover(6000), [("a", b"x")], entropy=bytes(32))
    sizes, decrypt = [], reading.decrypt

    def counted(data_key: bytes, encrypted: bytes, associated: bytes) -> bytes:
        sizes.append(len(encrypted))
        decrypt(data_key, encrypted, associated) if len(sizes) == 1 else None
        raise InputError("so that all is tried that ever is")

    monkeypatch.setattr(reading, "decrypt", counted)
    for name in "ab":
        with pytest.raises(Exception, match="the key is right" if name == "a" else "opens nothing"):
            extract(stego, name)
    assert 1 <= len(sizes) <= 4
    largest = max(header.bucket_bytes(bucket) for bucket in range(256))
    assert math.log2(len(sizes) * 8 * (largest / 16) / 2**106) < -64
