"""The frozen vectors of the page's reader, read by Python."""

from __future__ import annotations

import json
import warnings
from typing import Any

import pytest

from keyss.core import KeyssWarning
from keyss.files import read_model
from keyss.methods.codec.model_bytes import decode
from vectors.make_vectors import FOLDER, carrier_bits, decode_rows, digests, open_file

REVEALED = json.loads((FOLDER / "revealed.json").read_text())
ENCODED = json.loads((FOLDER / "encoded.json").read_text())
COUNTED = json.loads((FOLDER / "counted.json").read_text())
KEYSS = json.loads((FOLDER / "keyss.json").read_text())
PUBLISHED = json.loads((FOLDER / "published.json").read_text())


def marks(expected: dict[str, Any]) -> list[pytest.MarkDecorator]:
    """Keys of secrets in colours are derived under many salts."""
    return [pytest.mark.slow] if expected["file"].startswith("colours.") else []


@pytest.mark.argon2
@pytest.mark.parametrize(
    "expected",
    [pytest.param(each, id=f"{each['file']} {each['key']}", marks=marks(each)) for each in REVEALED],
)
def test_reveal(expected: dict[str, Any]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", KeyssWarning)
        assert open_file(expected["file"], expected["key"]) == expected


@pytest.mark.parametrize("name", PUBLISHED)
def test_published_files(name: str) -> None:
    assert digests(read_model(FOLDER / name)) == PUBLISHED[name]


@pytest.mark.parametrize("expected", ENCODED, ids=lambda each: f"{len(each['data']) // 2} bytes")
def test_encoded_models(expected: dict[str, Any]) -> None:
    assert digests(decode(bytes.fromhex(expected["data"]))) == expected["sha256"]


@pytest.mark.parametrize("name", COUNTED["bits"])
def test_carrier_bits(name: str) -> None:
    assert carrier_bits(read_model(FOLDER / name)) == COUNTED["bits"][name]


@pytest.mark.parametrize("expected", KEYSS, ids=lambda each: f"{each['file']} {each['count']}")
def test_decoders(expected: dict[str, Any]) -> None:
    found = decode_rows(bytes.fromhex(expected["payload"]), read_model(FOLDER / expected["file"]))
    assert found["count"] == expected["count"]
    for name, values in expected["rows"].items():
        assert found["rows"][name] == pytest.approx(values, abs=1e-5, rel=1e-5)
