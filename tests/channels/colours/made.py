"""Models, and bytes in their colours."""

from __future__ import annotations

from collections.abc import Sequence

from keyss.channels import COLOURS, ColoursReader, Payload, PreparedCover
from keyss.core import Gaussians
from lab.lifelike import lifelike

METHOD = "t"
PACKED = 1 + len(METHOD)  # bytes beside the data


def cover(count: int = 4000, seed: int = 0) -> Gaussians:
    return lifelike(count, seed).with_sh_degree(0)


def embed(
    cover: Gaussians | PreparedCover, secrets: Sequence[tuple[str, bytes]], entropy: bytes | None = None
) -> Gaussians:
    prepared = COLOURS.prepare(cover) if isinstance(cover, Gaussians) else cover
    return prepared.embed([(key, Payload(METHOD, data)) for key, data in secrets], entropy=entropy)


def extract(stego: Gaussians, key: str) -> bytes:
    return ColoursReader.of(stego).open(key).data
