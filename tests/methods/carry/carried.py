"""Embeds models in the low bits of a model in memory, and extracts them."""

from __future__ import annotations

from collections.abc import Sequence

from keyss.channels import LOW_BITS, LowBitsReader, Payload
from keyss.core import Gaussians
from keyss.methods import CarriedSecret
from keyss.methods.codec.model_bytes import encode


def embed(
    cover: Gaussians, secrets: Sequence[tuple[str, Gaussians]], entropy: bytes | None = None
) -> Gaussians:
    payloads = [(key, Payload("carry", encode(model))) for key, model in secrets]
    return LOW_BITS.prepare(cover).embed(payloads, entropy=entropy)


def extract(stego: Gaussians, key: str) -> CarriedSecret:
    return CarriedSecret.of(LowBitsReader.of(stego).open(key))
