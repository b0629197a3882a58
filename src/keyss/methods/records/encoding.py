"""Whole models in the low bits of another: each secret Gaussian lies, quantised, in one of the cover's.

A Gaussian is a record (see `quantise`) of the channel; the header tells how records are decoded and how many
there were. Copies of the most visible Gaussians are embedded a second time as far as there is room.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import torch

from keyss.channels import LOW_BITS, PreparedCover, RecordPlan, RecordRequest, Records
from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.methods.records.opening import COUNT
from keyss.methods.records.quantise import Codec
from keyss.methods.records.table import Table

METHOD = "carry"  # opens what is embedded


def record_request(count: int, sh_degree: int) -> RecordRequest:
    """What a model of `count` Gaussians asks of a channel."""
    header_bytes = COUNT.size + Codec.packed_size(sh_degree)
    return RecordRequest(count, Table.floor(sh_degree).record_bytes, header_bytes)


def record_requests(models: Sequence[Gaussians]) -> list[RecordRequest]:
    """What models ask of a channel together."""
    return [record_request(len(model), model.sh_degree) for model in models]


def record_degree(sh_degree: int) -> int | None:
    """The highest SH degree of secrets whose records fit into a Gaussian of `sh_degree`; None if none does.

    3, 2 and 0 in models of degree 3, 2 and 1.
    """
    room = LOW_BITS.largest_record(sh_degree)
    fitting = (each for each in range(sh_degree, -1, -1) if Table.floor(each).record_bytes <= room)
    return next(fitting, None)


def check_degrees(cover: int, secrets: Sequence[int]) -> None:
    """Raise UsageError if not even one Gaussian of these SH degrees fits into a Gaussian of the cover's."""
    degree = max(secrets, default=0)
    least, most = Table.floor(degree).record_bytes, LOW_BITS.largest_record(cover)
    if least > most:
        raise UsageError(
            f"a cover of SH degree {cover} cannot carry a secret of SH degree {degree}: one of its "
            f"Gaussians has room for {most} bytes, and one of the secret's takes at least {least}"
        )


def _encode(model: Gaussians, plan: RecordPlan) -> Records:
    """As precise as the plan has room for."""
    table = Table.of_size(8 * plan.record_bytes, model.sh_degree)
    if table is None:
        raise ValueError(f"{plan.record_bytes} bytes are too few for a record of SH degree {model.sh_degree}")
    codec = Codec.fit(model, table)
    header = COUNT.pack(len(model)) + codec.pack()
    return Records(METHOD, header, codec.encode(model), plan, most_visible_rows(model, plan.copies))


def encode_all(prepared: PreparedCover, models: Sequence[Gaussians]) -> list[Records]:
    """The records of all models, as they fit into one cover together. Raises UsageError if they do not."""
    plans = prepared.plan_records(record_requests(models))
    return [_encode(model, plan) for model, plan in zip(models, plans, strict=True)]


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
