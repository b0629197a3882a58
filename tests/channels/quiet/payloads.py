"""Payloads below the level of keys: into a model's low bits, and out again."""

from __future__ import annotations

from collections.abc import Sequence

from keyss.channels import LOW_BITS, Content, LowBitsCover, Payload, QuietReader
from keyss.channels.base import randomness
from keyss.channels.quiet.contents import bytes_of
from keyss.core import Gaussians
from keyss.keys import DerivedKey


def embed(model: Gaussians, secrets: Sequence[tuple[str, bytes]], entropy: bytes | None = None) -> Gaussians:
    contents = [(key, Payload("test", data)) for key, data in secrets]
    return LOW_BITS.prepare(model).embed(contents, entropy=entropy)


def embed_derived(
    model: Gaussians,
    secrets: Sequence[tuple[Sequence[DerivedKey], bytes]],
    entropy: bytes | None = None,
) -> Gaussians:
    contents = [(keys, Payload("test", data)) for keys, data in secrets]
    return embed_contents(LOW_BITS.prepare(model), contents, entropy)


def embed_contents(
    prepared: LowBitsCover,
    secrets: Sequence[tuple[Sequence[DerivedKey], Content]],
    entropy: bytes | None = None,
) -> Gaussians:
    """With a key under each salt, stale ones too."""
    mixed = randomness(entropy, *(bytes_of(content) for _, content in secrets))
    fresh = [([keys[i] for i in prepared.fresh_salts], content) for keys, content in secrets]
    return prepared.embed_derived(fresh, mixed)


def extract(stego: Gaussians, key: str) -> bytes:
    return _data(QuietReader.of(stego).open(key))


def extract_derived(stego: Gaussians | QuietReader, key: DerivedKey) -> bytes:
    reader = QuietReader.of(stego) if isinstance(stego, Gaussians) else stego
    return _data(reader.extract(key))


def _data(content: object) -> bytes:
    assert isinstance(content, Payload)
    assert content.method == "test"
    return content.data
