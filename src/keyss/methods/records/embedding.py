"""Embed models in a prepared cover, as records or payloads, and verify that they open.

In low bits a Gaussian is a record (see `quantise`); the header holds the number of records and the codec.
Copies of the most visible Gaussians fill free cells. All other channels carry a model as one payload (see
`whole`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from keyss.channels import (
    Capacity,
    Content,
    LowBitsCover,
    Payload,
    PreparedCover,
    RecordRequest,
    Records,
    open_content,
)
from keyss.core.gaussians import Gaussians
from keyss.methods.base import Stego
from keyss.methods.records.carried_secret import COUNT, unpack
from keyss.methods.records.lines import Table
from keyss.methods.records.precision import encode_to_size, most_visible_rows
from keyss.methods.records.quantise import Codec
from keyss.methods.records.whole import encode
from keyss.rendering.difference import Viewpoints

METHOD = "carry"  # the method that opens what is embedded


def embed_models(
    cover: PreparedCover,
    keys: Sequence[str],
    models: Sequence[Gaussians],
    *,
    viewpoints: Sequence[Viewpoints] | None = None,
    entropy: bytes | None = None,
    overwrite: bool = False,
) -> Stego:
    """Embed all Gaussians of each model under its key, and verify that they open.

    `viewpoints`: views of each model that determine the precision of a payload; by default, four around it.
    `overwrite`: write low bits into the cover's own tensors, which saves a copy. Raises UsageError if the
    models do not fit.
    """
    contents: Sequence[Content]
    if isinstance(cover, LowBitsCover):
        cover = replace(cover, overwrites=overwrite)
        contents = encode_all(cover, models)
        requests = [record_request(len(model), model.sh_degree) for model in models]
        details: dict[str, Any] = {
            "carriers": cover.cells.carriers,
            "capacity": cover.cells.record_capacity(requests),
        }
    else:
        contents = payloads = _payloads(cover, models, viewpoints or [*map(Viewpoints.around, models)])
        details = {
            "secret_bytes": [len(each.data) for each in payloads],
            "sh_degrees": [each.sh_degree for each in models],
        }
        if not cover.capacity.grows:
            details["capacity_bytes"] = cover.capacity.bytes
            details["capacity_bits_per_gaussian"] = round(8 * cover.capacity.bytes / len(cover.cover), 2)
    stego = cover.embed(list(zip(keys, contents, strict=True)), entropy=entropy)
    del contents  # as large as the secrets
    opened = [unpack(open_content(stego, key)) for key in keys]
    if [each.left for each in opened] != list(map(len, models)):
        raise RuntimeError("the embedded secrets do not open again as they should")
    details["bits_per_gaussian"] = [each.bits for each in opened]
    return Stego(stego, tuple(opened), details=details, verified=True)


def encode_all(cover: LowBitsCover, models: Sequence[Gaussians]) -> list[Records]:
    """The records of all models, at the best precision that fits. Raises UsageError if none does."""
    plans = cover.cells.plan_records([record_request(len(model), model.sh_degree) for model in models])
    found = []
    for model, plan in zip(models, plans, strict=True):
        table = Table.of_size(8 * plan.record_bytes, model.sh_degree)
        assert table is not None  # the plan has room for `Table.floor`
        codec, outlier = Codec.fit(model, table)
        header = COUNT.pack(len(model)) + codec.pack()
        copied = most_visible_rows(model, plan.copies)
        found.append(Records(METHOD, header, codec.encode(model, outlier), plan, copied))
    return found


def record_request(count: int, sh_degree: int) -> RecordRequest:
    """The request to a channel for a model of `count` Gaussians."""
    header_bytes = COUNT.size + Codec.packed_size(sh_degree)
    return RecordRequest(count, Table.floor(sh_degree).record_bytes, header_bytes)


def largest_degree(record_bytes: int) -> int | None:
    """The maximum SH degree of records of at most `record_bytes`; None if none fits."""
    return next((each for each in (3, 2, 1, 0) if Table.floor(each).record_bytes <= record_bytes), None)


def shares(capacity: Capacity, needed: Sequence[int]) -> list[int]:
    """Maximum bytes of each secret's payload, for secrets that need `needed` bytes.

    The first of a quarter, a half and all of the capacity that suffices: a secret's precision then does not
    depend on the others, and its key does not reveal them. Equal shares if these exceed the capacity, or if
    the model grows.
    """
    parts = [
        next((each for each in (4, 2) if size <= capacity.bytes // each - capacity.overhead), 1)
        for size in needed
    ]
    if capacity.grows or sum(1 / each for each in parts) > 1:
        parts = [len(needed)] * len(needed)
    return [max(0, capacity.bytes // each - capacity.overhead) for each in parts]


def _payloads(
    cover: PreparedCover, models: Sequence[Gaussians], viewpoints: Sequence[Viewpoints]
) -> list[Payload]:
    limits = shares(cover.capacity, [len(encode(model)) for model in models])
    return [
        Payload(METHOD, encode_to_size(model, limit, short=cover.capacity.grows, viewpoints=views))
        for model, limit, views in zip(models, limits, viewpoints, strict=True)
    ]
