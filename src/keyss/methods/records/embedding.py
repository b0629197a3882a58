"""Models into the low bits of a prepared cover, and opened again as their readers will."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from keyss.channels import Content, Payload, PreparedCover, Room, open_content
from keyss.core.gaussians import Gaussians
from keyss.methods.records import precision
from keyss.methods.records.encoding import METHOD, encode_all, record_requests
from keyss.methods.records.opening import CarriedSecret, unpack
from keyss.rendering.difference import Viewpoints


@dataclass(frozen=True)
class Embedded:
    """What embedding gives."""

    stego: Gaussians
    opened: tuple[CarriedSecret, ...]
    details: dict[str, Any]  # numbers for metrics.json


def embed_models(
    prepared: PreparedCover,
    keys: Sequence[str],
    models: Sequence[Gaussians],
    *,
    entropy: bytes | None = None,
) -> Embedded:
    """All Gaussians of each model, under its key, opened again. Raises UsageError if they do not fit."""
    records = encode_all(prepared, models)
    stego = prepared.embed(list(zip(keys, records, strict=True)), entropy=entropy)
    found = _opened([open_content(stego, key) for key in keys], models)
    details: dict[str, Any] = {
        "carriers": prepared.carriers,
        "capacity": prepared.record_capacity(record_requests(models)),
        "bits_per_gaussian": [each.bits for each in found],
    }
    return Embedded(stego, found, details)


def embed_whole(
    room: PreparedCover,
    keys: Sequence[str],
    models: Sequence[Gaussians],
    viewpoints: Sequence[Viewpoints],
    *,
    prune: bool,
    entropy: bytes | None = None,
) -> Embedded:
    """All of each model, or with `prune` what fits, under its key, opened again; see `shares_of`.

    `viewpoints`: from where each is looked at, which tells how precise it has to be. Raises UsageError if
    they do not fit.
    """
    rooms = shares_of(room, models)
    fitted = [
        precision.fitted(model, share, prune=prune, short=room.grows, viewpoints=views)
        for model, share, views in zip(models, rooms, viewpoints, strict=True)
    ]
    payloads = [Payload(METHOD, data) for _, data in fitted]
    stego = room.embed(list(zip(keys, payloads, strict=True)), entropy=entropy)
    opened = _opened([open_content(stego, key) for key in keys], [kept for kept, _ in fitted])
    details: dict[str, Any] = {
        "secret_bytes": [len(data) for _, data in fitted],
        "sh_degrees": [each.gaussians.sh_degree for each in opened],
        "bits_per_gaussian": [each.bits for each in opened],
    }
    if not room.grows:
        details["capacity_bytes"] = room.capacity
        details["capacity_bits_per_gaussian"] = round(8 * room.capacity / len(stego), 2)
    return Embedded(stego, opened, details)


def shares_of(room: Room, models: Sequence[Gaussians]) -> list[int]:
    """Bytes that the encoding of each model may take."""
    if len(models) == 1 and room.grows:
        return [room.capacity - room.overhead]
    return shares([precision.least_bytes(model) for model in models], room.capacity, room.overhead)


def shares(needed: Sequence[int], capacity: int, overhead: int) -> list[int]:
    """Bytes that each secret may take, of which so many are `needed`.

    A quarter of the capacity, half of it or all, whichever is enough: then a secret is as precise as it would
    be alone, and its key tells nothing of others. Where that is too much for all of them, equal shares.
    """
    parts = [next((each for each in (4, 2) if size <= capacity // each - overhead), 1) for size in needed]
    if sum(1 / each for each in parts) > 1:
        parts = [len(needed)] * len(needed)
    return [max(0, capacity // each - overhead) for each in parts]


def _opened(contents: Sequence[Content], models: Sequence[Gaussians]) -> tuple[CarriedSecret, ...]:
    """The secrets as their readers get them. Raises RuntimeError if these are not all of the `models`."""
    found = tuple(map(unpack, contents))
    if [len(each.gaussians) for each in found] != list(map(len, models)):
        raise RuntimeError("what was written does not open again as it should")
    return found
