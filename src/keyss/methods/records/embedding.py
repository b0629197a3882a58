"""Models into the low bits of a prepared cover, and opened again as their readers will."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from keyss.channels.base import Content, Payload, Records
from keyss.channels.low_bits import LOW_BITS, LowBitsCover
from keyss.channels.opening import open_content
from keyss.channels.rooms import Room
from keyss.core.errors import InputError
from keyss.core.gaussians import Gaussians
from keyss.methods.records import precision, whole
from keyss.methods.records.encoding import CarriedSecret, decode, encode_all, most_visible, record_requests
from keyss.methods.records.quantise import out_of_range
from keyss.rendering.difference import Viewpoints, cost

OPENED_BY = "carry"  # the method that opens what is embedded whole, whoever trained it


@dataclass(frozen=True)
class Embedded:
    """What embedding gives."""

    prepared: LowBitsCover
    models: Sequence[Gaussians]  # whole
    kept: Sequence[Gaussians]  # what of them was embedded
    stego: Gaussians
    opened: tuple[CarriedSecret, ...]

    def details(self, cover: Gaussians) -> dict[str, Any]:
        """Numbers for metrics.json, some of which take renders; `cover`: before it was prepared."""
        details: dict[str, Any] = {
            "carriers": self.prepared.carriers,
            "capacity": self.prepared.record_capacity(record_requests(self.models)),
            "gaussians_before_pruning": [len(model) for model in self.models],
            "bits_per_gaussian": [each.bits for each in self.opened],
        }
        if any(clamped := [out_of_range(model) for model in self.kept]):
            details["gaussians_with_clamped_numbers"] = clamped
        pairs = list(zip(self.models, self.kept, strict=True))
        if any(part is not model for model, part in pairs):
            details["share_kept_by_pruning"] = [round(len(part) / len(model), 4) for model, part in pairs]
            details["pruned_secret_psnr_against_the_whole"] = [
                None if part is model else round(cost(model, part), 1) for model, part in pairs
            ]
        if self.prepared.cover is not cover:
            details["dithered_cover_psnr_against_the_one_before"] = round(cost(cover, self.prepared.cover), 1)
        return details


def embed_models(
    prepared: LowBitsCover,
    keys: Sequence[str],
    models: Sequence[Gaussians],
    counts: Sequence[int],
    method: str,
    *,
    entropy: bytes | None = None,
) -> Embedded:
    """Of each model its `counts` most visible Gaussians, under its key, opened again.

    `method`: the name of the one that will open them. Raises UsageError if they do not fit.
    """
    kept = [most_visible(model, count) for model, count in zip(models, counts, strict=True)]
    records = encode_all(prepared, kept, method)
    stego = prepared.embed(list(zip(keys, records, strict=True)), entropy=entropy)
    opened = tuple(unpack_records(LOW_BITS.extract(stego, key)) for key in keys)
    if [len(each.gaussians) for each in opened] != [len(model) for model in kept]:
        raise RuntimeError("what was written does not open again as it should")
    return Embedded(prepared, models, kept, stego, opened)


@dataclass(frozen=True)
class EmbeddedWhole:
    """What embedding models whole gives."""

    stego: Gaussians
    opened: tuple[CarriedSecret, ...]
    details: dict[str, Any]  # numbers for metrics.json


def embed_whole(
    room: Room,
    keys: Sequence[str],
    models: Sequence[Gaussians],
    viewpoints: Sequence[Viewpoints],
    *,
    prune: bool,
    entropy: bytes | None = None,
) -> EmbeddedWhole:
    """All of each model, or with `prune` what fits, under its key, opened again; see `shares_of`.

    `viewpoints`: from where each is looked at, which tells how precise it has to be. Raises UsageError if
    they do not fit.
    """
    shares = shares_of(room, models)
    fitted = [
        precision.fitted(model, share, prune=prune, short=room.grows, viewpoints=views)
        for model, share, views in zip(models, shares, viewpoints, strict=True)
    ]
    payloads = [Payload(OPENED_BY, data) for _, data in fitted]
    stego = room.embed(list(zip(keys, payloads, strict=True)), entropy=entropy)
    opened = tuple(unpack_records(open_content(stego, key)) for key in keys)
    if [len(each.gaussians) for each in opened] != [len(kept) for kept, _ in fitted]:
        raise RuntimeError("what was written does not open again as it should")
    details: dict[str, Any] = {
        "secret_bytes": [len(data) for _, data in fitted],
        "gaussians_before_pruning": [len(model) for model in models],
        "sh_degrees": [each.gaussians.sh_degree for each in opened],
        "bits_per_gaussian": [each.bits for each in opened],
    }
    if not room.grows:
        details["capacity_bytes"] = room.capacity
        details["capacity_bits_per_gaussian"] = round(8 * room.capacity / len(stego), 2)
    return EmbeddedWhole(stego, opened, details)


def shares_of(room: Room, models: Sequence[Gaussians]) -> list[int]:
    """Bytes that the encoding of each model may take.

    A quarter of the room, half of it or all, whichever is enough: then a secret is as precise as it would be
    alone, and its key tells nothing of others. Where that is too much for all of them, equal shares.
    """
    capacity, overhead = room.capacity, room.overhead
    if len(models) == 1 and room.grows:
        return [capacity - overhead]
    parts = [_parts_alone(precision.least_bytes(model), capacity, overhead) for model in models]
    if sum(1 / each for each in parts) > 1:
        parts = [len(models)] * len(models)
    return [max(0, capacity // each - overhead) for each in parts]


def _parts_alone(size: int, capacity: int, overhead: int) -> int:
    """Of how many parts of the capacity one is enough for `size` bytes."""
    return next((parts for parts in (4, 2) if size <= capacity // parts - overhead), 1)


def unpack_records(content: Content) -> CarriedSecret:
    """The Gaussians that are left. Raises InputError for damage."""
    if isinstance(content, Payload):
        return whole.decode(content.data)
    if not isinstance(content, Records):
        raise InputError("the hidden secret is damaged: expected records or one payload")
    return decode(content)
