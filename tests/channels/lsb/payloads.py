"""Bytes into the low bits of a model, and out again."""

from __future__ import annotations

from collections.abc import Sequence

from keyss.channels import LOW_BITS, LowBitsReader, Payload
from keyss.core import Gaussians


def embed(model: Gaussians, secrets: Sequence[tuple[str, bytes]], entropy: bytes | None = None) -> Gaussians:
    payloads = [(key, Payload("test", data)) for key, data in secrets]
    return LOW_BITS.prepare(model).embed(payloads, entropy=entropy)


def extract(stego: Gaussians, key: str) -> bytes:
    payload = LowBitsReader.of(stego).open(key)
    assert payload.method == "test"
    return payload.data
