"""Carrying below the level of files: models into a model's low bits, and out again."""

from __future__ import annotations

from collections.abc import Sequence

from keyss.channels.base import Records
from keyss.channels.low_bits import LOW_BITS, LowBitsReader
from keyss.core import Gaussians
from keyss.keys import DerivedKey
from keyss.methods.records.encoding import (
    CarriedSecret,
    decode,
    encode_all,
    most_visible,
    subsampled_counts,
)


def embed(
    cover: Gaussians, secrets: Sequence[tuple[str, Gaussians]], entropy: bytes | None = None
) -> Gaussians:
    prepared = LOW_BITS.prepare(cover)
    records = encode_all(prepared, [model for _, model in secrets], "carry")
    return prepared.embed(list(zip((key for key, _ in secrets), records, strict=True)), entropy=entropy)


def embed_derived(
    cover: Gaussians,
    secrets: Sequence[tuple[Sequence[DerivedKey], Gaussians]],
    entropy: bytes | None = None,
) -> Gaussians:
    prepared = LOW_BITS.prepare(cover)
    records = encode_all(prepared, [model for _, model in secrets], "carry")
    keyed = list(zip((keys for keys, _ in secrets), records, strict=True))
    return prepared.embed_derived(keyed, entropy=entropy)


def pruned_to_fit(cover: Gaussians, secret: Gaussians) -> Gaussians:
    """As much of `secret` as `cover` carries."""
    (count,) = subsampled_counts(LOW_BITS.prepare(cover), [secret])
    return most_visible(secret, count)


def extract(stego: Gaussians, key: str) -> CarriedSecret:
    content = LOW_BITS.extract(stego, key)
    assert isinstance(content, Records)
    return decode(content)


def extract_derived(reader: LowBitsReader, key: DerivedKey) -> CarriedSecret:
    content = reader.extract(key)
    assert isinstance(content, Records)
    return decode(content)
