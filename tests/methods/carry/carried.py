"""Embeds models in the low bits of a model in memory, and extracts them."""

from __future__ import annotations

from collections.abc import Sequence

from channels.quiet.payloads import embed_contents
from keyss.channels import LOW_BITS, QuietReader
from keyss.core import Gaussians
from keyss.keys import DerivedKey
from keyss.methods import CarriedSecret, encode_all, unpack


def embed(
    cover: Gaussians, secrets: Sequence[tuple[str, Gaussians]], entropy: bytes | None = None
) -> Gaussians:
    prepared = LOW_BITS.prepare(cover)
    records = encode_all(prepared, [model for _, model in secrets])
    return prepared.embed(list(zip((key for key, _ in secrets), records, strict=True)), entropy=entropy)


def embed_derived(
    cover: Gaussians,
    secrets: Sequence[tuple[Sequence[DerivedKey], Gaussians]],
    entropy: bytes | None = None,
) -> Gaussians:
    prepared = LOW_BITS.prepare(cover)
    records = encode_all(prepared, [model for _, model in secrets])
    keyed = list(zip((keys for keys, _ in secrets), records, strict=True))
    return embed_contents(prepared, keyed, entropy)


def extract(stego: Gaussians, key: str) -> CarriedSecret:
    return unpack(QuietReader.of(stego).open(key))


def extract_derived(reader: QuietReader, key: DerivedKey) -> CarriedSecret:
    return unpack(reader.extract(key))
