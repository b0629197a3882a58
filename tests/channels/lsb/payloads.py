"""Payloads below the level of keys: into a model's low bits, and out again."""

from __future__ import annotations

from collections.abc import Sequence

from keyss.channels import LOW_BITS, LowBitsCover, LowBitsReader, Payload
from keyss.channels.container import randomness
from keyss.core import Gaussians
from keyss.keys import DerivedKey


def embed(model: Gaussians, secrets: Sequence[tuple[str, bytes]], entropy: bytes | None = None) -> Gaussians:
    payloads = [(key, Payload("test", data)) for key, data in secrets]
    return LOW_BITS.prepare(model).embed(payloads, entropy=entropy)


def embed_derived(
    model: Gaussians,
    secrets: Sequence[tuple[Sequence[DerivedKey], bytes]],
    entropy: bytes | None = None,
) -> Gaussians:
    payloads = [(keys, Payload("test", data)) for keys, data in secrets]
    return embed_payloads(LOW_BITS.prepare(model), payloads, entropy)


def embed_payloads(
    prepared: LowBitsCover,
    secrets: Sequence[tuple[Sequence[DerivedKey], Payload]],
    entropy: bytes | None = None,
) -> Gaussians:
    """With a key under each salt, stale ones too."""
    mixed = randomness(entropy, [payload for _, payload in secrets])
    fresh = [([keys[i] for i in prepared.fresh_salts], payload) for keys, payload in secrets]
    return prepared.embed_derived(fresh, mixed)


def extract(stego: Gaussians, key: str) -> bytes:
    return _data(LowBitsReader.of(stego).open(key))


def extract_derived(stego: Gaussians | LowBitsReader, key: DerivedKey) -> bytes:
    reader = LowBitsReader.of(stego) if isinstance(stego, Gaussians) else stego
    return _data(reader.extract(key))


def _data(payload: Payload) -> bytes:
    assert payload.method == "test"
    return payload.data
