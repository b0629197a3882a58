"""Whole models in the low bits of another: each secret Gaussian lies, quantised, in one of the cover's.

A Gaussian is a record (see `quantise`) of the channel; the header tells how records are decoded and how many
there were. Copies of the most visible Gaussians are embedded a second time as far as there is room.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from keyss.channels.base import Channel, PreparedCover, RecordPlan, RecordRequest, Records
from keyss.core.errors import InputError, UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.pruning_compensation import compensate_pruning
from keyss.methods.base import Frame, Remains
from keyss.methods.records.quantise import Codec
from keyss.methods.records.table import Table

_COUNT = struct.Struct("<I")


@dataclass(frozen=True)
class CarriedSecret:
    """A secret as it comes out; see `keyss.methods.base.Opened`."""

    gaussians: Gaussians  # those that are left, in the order of their carriers
    count: int  # how many were embedded
    bits: int  # of a record
    frame: None = None
    decode: None = None

    def reveal(self, stego: Gaussians, *, frame: Frame = "secret", force: bool = False) -> Gaussians:
        """The Gaussians that are left make up for those that were lost with their carriers."""
        if frame == "cover":
            raise UsageError(
                'a carried secret never lay in the cover\'s coordinates: leave out `frame="cover"`'
            )
        return compensate_pruning(self.gaussians, self.count)

    def remains(self, revealed: Gaussians) -> Remains:
        return Remains(len(revealed), self.count)

    def fingerprint(self) -> str:
        return hashlib.sha256(self.gaussians.means.numpy().tobytes()).hexdigest()[:16]


def record_request(count: int, sh_degree: int) -> RecordRequest:
    """What a model of `count` Gaussians asks of a channel."""
    header_bytes = _COUNT.size + Codec.packed_size(sh_degree)
    return RecordRequest(count, Table.floor(sh_degree).record_bytes, header_bytes)


def record_requests(models: Sequence[Gaussians]) -> list[RecordRequest]:
    """What models ask of a channel together."""
    return [record_request(len(model), model.sh_degree) for model in models]


def check_degrees(channel: Channel, cover: int, secrets: Sequence[int]) -> None:
    """Raise UsageError if not even one Gaussian of these SH degrees fits into a Gaussian of the cover's."""
    degree = max(secrets, default=0)
    least, most = Table.floor(degree).record_bytes, channel.largest_record(cover)
    if least > most:
        how = (
            '`method="learned"` can hide it'
            if cover > 0
            else '`method="learned", sh_degree=1` or `publish="any"` can hide it'
        )
        raise UsageError(
            f"a cover of SH degree {cover} cannot carry a secret of SH degree {degree}: one of its "
            f"Gaussians has room for {most} bytes, and one of the secret's takes at least {least}; "
            f"{how}"
        )


def _encode(model: Gaussians, plan: RecordPlan, method: str) -> Records:
    """As precise as the plan has room for."""
    table = Table.of_size(8 * plan.record_bytes, model.sh_degree)
    if table is None:
        raise ValueError(f"{plan.record_bytes} bytes are too few for a record of SH degree {model.sh_degree}")
    codec = Codec.fit(model, table)
    header = _COUNT.pack(len(model)) + codec.pack()
    return Records(method, header, codec.encode(model), plan, most_visible_rows(model, plan.copies))


def decode(records: Records) -> CarriedSecret:
    """The secret of records in any order, some of which may be lost. Raises InputError for damage."""
    if len(records.header) < _COUNT.size:
        raise InputError("the hidden parameters are damaged: they are too short")
    (count,) = _COUNT.unpack_from(records.header)
    codec = Codec.unpack(records.header[_COUNT.size :])
    expected, found = codec.table.record_bytes, records.records.shape[1]
    if found != expected:
        raise InputError(f"the hidden parameters are damaged: records of {found} bytes, expected {expected}")
    return CarriedSecret(codec.decode(records.records), count, codec.table.total)


def encode_all(prepared: PreparedCover, models: Sequence[Gaussians], method: str) -> list[Records]:
    """The records of all models, as they fit into one cover together. Raises UsageError if they do not.

    `method`: the name of the one that will open them.
    """
    plans = prepared.plan_records(record_requests(models))
    return [_encode(model, plan, method) for model, plan in zip(models, plans, strict=True)]


def subsampled_counts(prepared: PreparedCover, models: Sequence[Gaussians]) -> list[int]:
    """How many Gaussians of each model are kept so that all fit: the largest models give first.

    Raises UsageError if nothing fits at all.
    """
    left = prepared.record_capacity(record_requests(models))
    if left < len(models):
        raise UsageError(
            f"nothing fits into this cover: {prepared.carriers:,} of its {len(prepared.cover):,} Gaussians "
            "can carry something, and the headers of the secrets take them all"
        )
    counts: dict[int, int] = {}
    for index in sorted(range(len(models)), key=lambda i: len(models[i])):
        counts[index] = min(len(models[index]), left // (len(models) - len(counts)))
        left -= counts[index]
    return [counts[index] for index in range(len(models))]


def most_visible(gaussians: Gaussians, count: int) -> Gaussians:
    """The `count` Gaussians of `most_visible_rows`; all of them if there are no more."""
    if count >= len(gaussians):
        return gaussians
    return gaussians[torch.from_numpy(most_visible_rows(gaussians, count))]


def most_visible_rows(gaussians: Gaussians, count: int) -> npt.NDArray[np.int64]:
    """[count] the Gaussians with the largest opacity times size, in their order.

    Size is the square root of the cross-section, and no more than that of a typical large Gaussian: else a
    few huge faint ones would stay before all detail.
    """
    size = gaussians.log_scales.sort(dim=1).values[:, 1:].mean(1)  # log, of the larger two axes
    at_most = size.kthvalue(int(0.9 * len(size)) + 1).values
    visibility = gaussians.opacities * size.clamp_max(at_most).exp()
    rows: npt.NDArray[np.int64] = visibility.topk(count).indices.sort().values.numpy()
    return rows
