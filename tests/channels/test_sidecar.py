"""The sealed sidecar: it opens for its keys, and anything else is a typed error."""

from __future__ import annotations

import os
from functools import partial

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from keyss.channels.base import Payload
from keyss.channels.sidecar import _HEADER, decrypt_sidecar, decrypt_slots, encrypt_sidecar, read_header
from keyss.core import InputError, KeyssError, UsageError, WrongKeyError
from keyss.keys import DerivedKey, KeyDerivation
from keyss.keys.encryption import bucket, decrypt, encrypt

ENTROPY = bytes(range(32))
KEY, OTHER = "first key of two", "second key of two"
PAYLOAD = Payload("test", b"a decoder" * 100)
OTHER_PAYLOAD = Payload("other", b"another")
DATA = encrypt_sidecar([(KEY, PAYLOAD), (OTHER, OTHER_PAYLOAD)], entropy=ENTROPY)
DERIVED = DerivedKey(KEY, read_header(DATA)[0])


def test_each_key_opens_its_own() -> None:
    assert decrypt_sidecar(DATA, KEY) == PAYLOAD
    assert decrypt_sidecar(DATA, OTHER) == OTHER_PAYLOAD
    with pytest.raises(WrongKeyError):
        decrypt_sidecar(DATA, "third key")


def test_how_many_secrets_there_are_does_not_show_up_to_four() -> None:
    sizes = {
        len(encrypt_sidecar([(f"key {i}", Payload("test", bytes(i))) for i in range(count)], entropy=ENTROPY))
        for count in (1, 2, 4)
    }
    assert len(sizes) == 1
    assert len(encrypt_sidecar([(f"key {i}", Payload("test", b"")) for i in range(5)])) > sizes.pop()


def test_the_same_entropy_gives_the_same_bytes_and_fresh_ones_others() -> None:
    secrets = [(KEY, PAYLOAD)]
    assert encrypt_sidecar(secrets, entropy=ENTROPY) == encrypt_sidecar(secrets, entropy=ENTROPY)
    assert encrypt_sidecar(secrets) != encrypt_sidecar(secrets)


@pytest.mark.parametrize(
    "keys",
    [[], ["k"] * 2, ["caf\u00e9", "cafe\u0301"], [str(i) for i in range(257)]],
)
def test_keys_that_make_no_sense_are_refused(keys: list[str]) -> None:
    with pytest.raises(UsageError):
        encrypt_sidecar([(key, PAYLOAD) for key in keys])


def test_a_thousand_random_keys_open_nothing() -> None:
    """Below Argon2id, whose output is replaced: it is what keys differ in."""
    assert decrypt_slots(DATA, DERIVED) == PAYLOAD
    for number in range(1000):
        with pytest.raises(WrongKeyError):
            decrypt_slots(DATA, DerivedKey.of_master(number.to_bytes(32, "little")))


def test_all_one_character_neighbours_open_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """All the way from the text, with the lowest costs of Argon2id that are read."""
    cheap = partial(KeyDerivation, time_cost=1, memory_kib=8192, parallelism=1)
    monkeypatch.setattr("keyss.channels.sidecar.KeyDerivation", cheap)
    key = "Kx7 pq"
    data = encrypt_sidecar([(key, PAYLOAD)], entropy=ENTROPY)
    monkeypatch.undo()
    assert decrypt_sidecar(data, key) == PAYLOAD
    printable = [chr(code) for code in range(32, 127)]
    neighbours = {key[:i] + c + key[i + 1 :] for i in range(len(key)) for c in printable}
    neighbours |= {key[:i] + key[i + 1 :] for i in range(len(key))}
    neighbours |= {key + c for c in printable} | {c + key for c in printable}
    for neighbour in neighbours - {key}:
        with pytest.raises(WrongKeyError):
            decrypt_sidecar(data, neighbour)


def test_a_hundred_forgeries_fail_closed() -> None:
    """Truncated, extended, and with one bit turned, wherever it is: nothing but a typed error comes out."""
    generator = iter(os.urandom(4096))
    slot_of_key = next(
        start
        for start in range(_HEADER.size, len(DATA), read_header(DATA)[2])
        if _opens(DATA[: _HEADER.size] + DATA[start : start + read_header(DATA)[2]])
    )
    forged = [DATA[: len(DATA) * i // 30] for i in range(30)] + [DATA + b"\0"]
    for i in range(_HEADER.size):
        forged.append(DATA[:i] + bytes([DATA[i] ^ 1 << next(generator) % 8]) + DATA[i + 1 :])
    for i in range(slot_of_key, slot_of_key + read_header(DATA)[2], 100):
        forged.append(DATA[:i] + bytes([DATA[i] ^ 1 << next(generator) % 8]) + DATA[i + 1 :])
    assert len(forged) >= 100
    for data in forged:
        with pytest.raises((InputError, WrongKeyError)):
            decrypt_slots(data, DERIVED)


def _opens(one_slot: bytes) -> bool:
    from cryptography.hazmat.primitives.keywrap import InvalidUnwrap, aes_key_unwrap

    try:
        aes_key_unwrap(DERIVED.expand("seal", 32), one_slot[_HEADER.size : _HEADER.size + 40])
    except InvalidUnwrap:
        return False
    return True


@pytest.mark.parametrize(
    ("at", "value", "words"),
    [
        (8, b"\x02", "version 2"),
        (25, b"\x00", "time_cost"),
        (25, b"\x05", "time_cost"),
        (26, (1 << 31).to_bytes(4, "little"), "memory_kib"),
        (26, (64).to_bytes(4, "little"), "memory_kib"),
        (30, b"\xff", "parallelism"),
        (31, (3).to_bytes(2, "little"), "slots"),
        (33, (1 << 31).to_bytes(4, "little"), "a slot"),
        (33, (100).to_bytes(4, "little"), "not a whole"),
    ],
)
def test_headers_out_of_range_are_refused_before_anything_is_derived(
    at: int, value: bytes, words: str
) -> None:
    with pytest.raises(InputError, match=words):
        read_header(DATA[:at] + value + DATA[at + len(value) :])


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=200), st.booleans())
def test_any_bytes_are_a_typed_error(data: bytes, begun: bool) -> None:
    with pytest.raises(KeyssError):
        decrypt_slots(DATA[:9] + data if begun else data, DERIVED)


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=5000))
def test_what_is_sealed_comes_back_and_its_size_is_coarse(payload: bytes) -> None:
    key = bytes(32)
    sealed = encrypt(key, payload, b"bound to this")
    assert decrypt(key, sealed, b"bound to this") == payload
    assert len(sealed) % 4096 == 0
    with pytest.raises(InputError):
        decrypt(key, sealed, b"bound to that")


def test_buckets_waste_at_most_a_quarter_and_are_few() -> None:
    sizes = [bucket(size) for size in range(1, 1 << 20, 501)]
    assert len(set(sizes)) < 60
    assert all(got >= size for got, size in zip(sizes, range(1, 1 << 20, 501), strict=True))
    assert all(
        got <= 1.25 * size for got, size in zip(sizes, range(1, 1 << 20, 501), strict=True) if size > 32768
    )


def test_a_bomb_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    sealed = encrypt(bytes(32), bytes(1_000_000))
    assert len(sealed) == 4096
    monkeypatch.setattr("keyss.keys.encryption.MAX_PAYLOAD_BYTES", 500_000)
    with pytest.raises(InputError, match="larger"):
        decrypt(bytes(32), sealed)
