"""What every channel offers: room for bits in a published model, and finding them again with a key.

A channel knows nothing of what its bits mean. It has two services. A *payload* is bytes that come out whole
or not at all. *Records* are many small pieces of one size that are found one by one: what is lost of the
model is lost of them, and no more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import numpy.typing as npt

from keyss.core.gaussians import Gaussians

Bytes = npt.NDArray[np.uint8]

METHOD_BYTES = 15  # of the name of a method in files


@dataclass(frozen=True)
class Payload:
    """Bytes that come out whole or not at all."""

    method: str  # who reads them, 1 to METHOD_BYTES ASCII characters
    data: bytes
    # Where it was cut into chunks that were read: those left and those that there were.
    chunks: tuple[int, int] | None = field(default=None, compare=False)


@dataclass(frozen=True)
class RecordRequest:
    """Records that are to be embedded, before they are encoded: their size is the channel's to choose."""

    count: int
    least_bytes: int  # of a record
    header_bytes: int


@dataclass(frozen=True)
class RecordPlan:
    """What the channel offers for a `RecordRequest`."""

    record_bytes: int  # at most so many may be used
    copies: int  # at most so many records may be embedded a second time
    cells_per_carrier: int  # records that share one Gaussian


@dataclass(frozen=True)
class Records:
    """Pieces of one size that come out one by one, in any order."""

    method: str  # who reads them, 1 to METHOD_BYTES ASCII characters
    header: bytes  # how they are to be read; comes out whole or not at all
    records: Bytes  # [R, size]
    plan: RecordPlan  # as the channel gave it
    # [C] indices of records that are embedded a second time, because losing them costs most; empty when read.
    copied: npt.NDArray[np.int64]


Content = Payload | Records


def pack_method(name: str) -> bytes:
    """METHOD_BYTES of the name of a method."""
    packed = name.encode("ascii")
    if not 1 <= len(packed) <= METHOD_BYTES:
        raise ValueError(f"expected the name of a method, 1 to {METHOD_BYTES} characters, got {name!r}")
    return packed.ljust(METHOD_BYTES, b"\0")


def unpack_method(packed: bytes) -> str:
    """The name of `pack_method`. Raises ValueError for anything else."""
    return packed[:METHOD_BYTES].rstrip(b"\0").decode("ascii")


class PreparedCover(Protocol):
    """A cover whose room in a channel is known: what fits is known before anything else runs."""

    @property
    def cover(self) -> Gaussians:
        """The cover."""

    @property
    def carriers(self) -> int:
        """Gaussians that can carry something."""

    def record_capacity(self, requests: Sequence[RecordRequest]) -> int:
        """Records that fit for all requests together, however many they ask for."""

    def plan_records(self, requests: Sequence[RecordRequest]) -> list[RecordPlan]:
        """How each request's records are to be encoded. Raises UsageError with the number that fits."""

    def embed(self, contents: Sequence[tuple[str, Content]], *, entropy: bytes | None = None) -> Gaussians:
        """The cover with one (key, content) for each secret in it; all contents are of one service.

        `entropy`: at least 32 bytes that nobody else can know, from which all that is random is derived; by
        default the system's. Raises UsageError for equal keys and for what does not fit. Warns (KeyssWarning)
        where the holder of one key can notice that there are other secrets.
        """


class Channel(Protocol):
    """A place for bits in a model."""

    def largest_record(self, sh_degree: int) -> int:
        """Bytes of the largest record in a model of this SH degree; 0 where there is no room at all."""

    def prepare(self, cover: Gaussians) -> PreparedCover:
        """Find the carriers. Raises InputError for a cover that cannot carry anything unseen."""

    def extract(self, stego: Gaussians, key: str) -> Content:
        """What `key` opens. Raises WrongKeyError when it opens nothing, InputError for what is damaged.

        Warns (KeyssWarning) where the key opens something else too.
        """
