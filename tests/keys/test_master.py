"""Keys derived from a master key: equal to an independent derivation, and unrelated."""

from __future__ import annotations

import hashlib
import hmac
import string

import pytest
from argon2.low_level import Type, hash_secret_raw

from keyss.core import UsageError
from keyss.keys import ALPHABET, MasterKey


@pytest.mark.argon2
def test_the_key_of_a_name_is_argon2id_and_hkdf_written_out() -> None:
    salt = hashlib.sha256(b"keyss/v1/master").digest()[:16]
    prk = hash_secret_raw(b"a master key", salt, 3, 64 * 1024, 4, 32, Type.ID)
    label = b"keyss/v1/master/" + hashlib.sha256("Säule/7".encode()).hexdigest().encode()
    number = int.from_bytes(hmac.new(prk, label + b"\x01", hashlib.sha256).digest(), "big")
    expected = ""
    for place in range(22):
        expected += (string.ascii_letters + string.digits)[number // 62**place % 62]
    assert MasterKey("a master key").key_of("Säule/7") == expected
    assert MasterKey("a master key").key_of("Sa\u0308ule/7") == expected  # however it was typed


def test_keys_are_unrelated_and_uniform() -> None:
    master = MasterKey("a master key")
    keys = {master.key_of(f"asset-{index}") for index in range(2000)}
    assert len(keys) == 2000
    assert not keys & {MasterKey("a master kez").key_of(f"asset-{index}") for index in range(2000)}
    counts = [sum(key.count(each) for key in keys) for each in ALPHABET]
    expected = 2000 * 22 / 62
    # Chi square with 61 degrees of freedom has a mean of 61 and a standard deviation of 11.
    assert sum((count - expected) ** 2 / expected for count in counts) < 61 + 6 * 11


@pytest.mark.parametrize("name", ["", "x" * 5000, "\udcff"])
def test_invalid_names_are_refused(name: str) -> None:
    with pytest.raises(UsageError):
        MasterKey("a master key").key_of(name)
