"""Known answers: files written today open tomorrow, and what must fail fails for the reason named."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from keyss.core import errors
from keyss.keys import DerivedKey, encryption

pytestmark = pytest.mark.argon2

FOLDER = Path(__file__).parents[3] / "tests" / "vectors"
DERIVATION = json.loads((FOLDER / "derivation.json").read_text())
ENCRYPTION = json.loads((FOLDER / "encryption.json").read_text())


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
