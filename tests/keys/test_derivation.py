"""Key derivation and encryption, by their definitions and by known answers."""

from __future__ import annotations

import hashlib
import hmac
import json
import string
from pathlib import Path
from typing import Any

import pytest
import torch
from argon2.low_level import Type, hash_secret_raw

from keyss.core import InputError, UsageError, errors
from keyss.keys import ALPHABET, DerivedKey, MasterKey, encryption, generate_key

pytestmark = pytest.mark.argon2

SALT = b"0123456789abcdef"
FOLDER = Path(__file__).parents[1] / "vectors"
DERIVATION = json.loads((FOLDER / "derivation.json").read_text())
ENCRYPTION = json.loads((FOLDER / "encryption.json").read_text())


def _expand(key: str, label: bytes, length: int) -> bytes:
    """HKDF-Expand (RFC 5869) of Argon2id with hashlib."""
    prk = hash_secret_raw(key.encode(), SALT, 3, 64 * 1024, 4, 32, Type.ID)
    block, result, counter = b"", b"", 1
    while len(result) < length:
        block = hmac.new(prk, block + label + bytes([counter]), hashlib.sha256).digest()
        result, counter = result + block, counter + 1
    return result[:length]


def test_argon2id_and_hkdf() -> None:
    key = DerivedKey.of("correct horse", SALT)
    assert key.verifier() == _expand("correct horse", b"keyss/v1/verifier", 32)
    words = _expand("correct horse", b"keyss/v1/embedding", 512)
    numbers = [int.from_bytes(words[i : i + 8], "little") / 2**64 for i in range(0, 512, 8)]
    normal = torch.distributions.Normal(0.0, 1.0).icdf(torch.tensor(numbers, dtype=torch.float64))
    torch.testing.assert_close(key.embedding(), (normal / normal.norm()).float(), rtol=0, atol=1e-6)


def test_embeddings() -> None:
    vectors = torch.stack([DerivedKey.of(k, SALT).embedding() for k in ("key", "kez", "Key", "keyy")])
    products = vectors @ vectors.T
    torch.testing.assert_close(products.diagonal(), torch.ones(4))
    assert (products - torch.eye(4)).abs().max() < 0.6  # 64 dimensions: a standard deviation of 0.125


def test_unicode_normalisation() -> None:
    composed, decomposed = DerivedKey.of("caf\u00e9 \ufb01", SALT), DerivedKey.of("cafe\u0301 fi", SALT)
    assert composed.verifier() == decomposed.verifier()
    assert composed.verifier() != DerivedKey.of("cafe fi", SALT).verifier()


def test_salt() -> None:
    one, other = (DerivedKey.of("key", salt) for salt in (SALT, b"fedcba9876543210"))
    assert one.verifier() != other.verifier()
    with pytest.raises(InputError, match="key derivation"):
        DerivedKey.of("key", b"short")


@pytest.mark.parametrize("key", ["", "x" * 5000])
def test_invalid_keys(key: str) -> None:
    with pytest.raises(UsageError):
        DerivedKey.of(key, SALT)


def test_generate_key() -> None:
    keys = {generate_key() for _ in range(50)}
    assert len(keys) == 50
    assert all(len(key) == 16 and key.isalnum() and key.isascii() for key in keys)
    assert len(generate_key(40)) == 40
    with pytest.raises(UsageError):
        generate_key(0)


def test_master_key() -> None:
    salt = hashlib.sha256(b"keyss/v1/master").digest()[:16]
    prk = hash_secret_raw(b"a master key", salt, 3, 64 * 1024, 4, 32, Type.ID)
    label = b"keyss/v1/master/" + hashlib.sha256("Säule/7".encode()).hexdigest().encode()
    number = int.from_bytes(hmac.new(prk, label + b"\x01", hashlib.sha256).digest(), "big")
    expected = ""
    for place in range(22):
        expected += (string.ascii_letters + string.digits)[number // 62**place % 62]
    assert MasterKey("a master key").key_of("Säule/7") == expected
    assert MasterKey("a master key").key_of("Sa\u0308ule/7") == expected


def test_asset_keys_are_uniform() -> None:
    keys, others = (
        {master.key_of(f"asset-{index}") for index in range(2000)}
        for master in (MasterKey("a master key"), MasterKey("a master kez"))
    )
    assert len(keys) == 2000
    assert not keys & others
    counts = [sum(key.count(each) for key in keys) for each in ALPHABET]
    expected = 2000 * 22 / 62
    # Chi square with 61 degrees of freedom has a mean of 61 and a standard deviation of 11.
    assert sum((count - expected) ** 2 / expected for count in counts) < 61 + 6 * 11


@pytest.mark.parametrize("name", ["", "x" * 5000, "\udcff"])
def test_invalid_names(name: str) -> None:
    with pytest.raises(UsageError):
        MasterKey("a master key").key_of(name)


def _derived(vector: dict[str, Any]) -> DerivedKey:
    return DerivedKey.of(vector["key"], bytes.fromhex(vector["salt"]))


@pytest.mark.parametrize("vector", DERIVATION["valid"], ids=lambda vector: ascii(vector["key"]))
def test_derivation(vector: dict[str, Any]) -> None:
    key = _derived(vector)
    assert key.verifier().hex() == vector["verifier"]
    for label in ("writer", "channel/key"):
        assert key.expand(label, 32).hex() == vector[label]
    assert key.embedding()[:4].tolist() == pytest.approx(vector["embedding_first_4"], abs=2e-6)


@pytest.mark.parametrize("vector", DERIVATION["invalid"], ids=lambda vector: vector["why"])
def test_derivation_that_must_fail(vector: dict[str, Any]) -> None:
    with pytest.raises(getattr(errors, vector["error"])):
        _derived(vector)


def test_encryption() -> None:
    vector = ENCRYPTION["valid"]
    data_key, associated = (bytes.fromhex(vector[name]) for name in ("data_key", "associated"))
    for name in ("encrypted", "stored"):
        payload = encryption.decrypt(data_key, bytes.fromhex(vector[name]), associated)
        assert payload.hex() == vector["payload"]


@pytest.mark.parametrize("vector", ENCRYPTION["invalid"], ids=lambda vector: vector["why"])
def test_invalid_encrypted_data(vector: dict[str, Any]) -> None:
    good = ENCRYPTION["valid"]
    with pytest.raises(getattr(errors, vector["error"]), match=vector["words"]):
        encryption.decrypt(
            bytes.fromhex(good["data_key"]),
            bytes.fromhex(vector["encrypted"]),
            bytes.fromhex(good["associated"]),
        )
