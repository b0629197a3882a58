"""The one protocol of all channels: places in a published model where bits can lie, to be found with a key.

A channel knows nothing of what its bits mean. Every channel carries *payloads*: bytes that come out whole or
not at all. Some carry *records* too: many small pieces of one size that are found one by one, so that a model
that lost Gaussians has lost as many records and no more.

Four channels implement it: `low_bits`, `codes`, `appended` and `colours`. Which one a hiding uses follows
from where the model will be published (`publishing`); readers try them all (`opening`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import numpy.typing as npt

from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians

Bytes = npt.NDArray[np.uint8]

METHOD_BYTES = 15  # of the name of a method in files


@dataclass(frozen=True)
class Payload:
    """Bytes that come out whole or not at all."""

    method: str  # who reads them, 1 to METHOD_BYTES ASCII characters
    data: bytes
    # Where it was cut into chunks: those that were read and those that were written.
    chunks: tuple[int, int] | None = field(default=None, compare=False)


@dataclass(frozen=True)
class RecordRequest:
    """Records that are to be embedded, before they are encoded: the channel chooses their size."""

    count: int
    least_bytes: int  # of a record
    header_bytes: int


@dataclass(frozen=True)
class RecordPlan:
    """What the channel offers for a `RecordRequest`."""

    record_bytes: int  # the most that a record may have
    copies: int  # the most records that may be embedded a second time
    cells_per_carrier: int  # records that share one Gaussian


@dataclass(frozen=True)
class Records:
    """Pieces of one size that come out one by one, in any order."""

    method: str  # who reads them, 1 to METHOD_BYTES ASCII characters
    header: bytes  # how they are read; comes out whole or not at all
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


class Room(Protocol):
    """What fits into a cover: exact for a prepared one, estimated for one that is still to be fitted."""

    @property
    def carriers(self) -> int:
        """Gaussians that can carry something."""

    @property
    def capacity(self) -> int:
        """Bytes of all payloads together."""

    @property
    def overhead(self) -> int:
        """Bytes that a payload takes beside its data, at most."""

    @property
    def grows(self) -> bool:
        """Whether the model grows by what is hidden, so that this should be short."""

    def record_capacity(self, requests: Sequence[RecordRequest]) -> int:
        """Records that fit for all requests together, however many they ask for; 0 without records."""

    def plan_records(self, requests: Sequence[RecordRequest]) -> list[RecordPlan]:
        """How each request's records are to be encoded. Raises UsageError with the number that fits."""


class PreparedCover(Room, Protocol):
    """A cover whose room in a channel is known: what fits is known before anything else runs."""

    @property
    def cover(self) -> Gaussians:
        """The cover."""

    def embed(self, contents: Sequence[tuple[str, Content]], *, entropy: bytes | None = None) -> Gaussians:
        """The cover with one (key, content) for each secret in it; all contents are payloads, or records.

        `entropy`: at least 32 bytes that nobody else can know, from which all that is random is derived; by
        default the system's. Raises UsageError for equal keys and for what does not fit. Warns (KeyssWarning)
        where the holder of one key can notice that there are other secrets.
        """


class Reader(Protocol):
    """A stego model as a channel reads it."""

    def open(self, key: str) -> Content:
        """What `key` opens. Raises WrongKeyError when it opens nothing, InputError for what is damaged.

        Warns (KeyssWarning) where the key opens something else too.
        """


class Channel(Protocol):
    """A place for bits in a model."""

    @property
    def name(self) -> str:
        """`low_bits`, `codes`, `appended` or `colours`."""

    @property
    def place(self) -> str:
        """What the secret lies in, for messages: "low bits", "codes of the spz file" and so on."""

    @property
    def survives(self) -> bool:
        """Whether secrets survive conversion to other formats; else the file is passed on as it is."""

    @property
    def grows(self) -> bool:
        """Whether the model grows by what is hidden; see `Room`."""

    @property
    def records(self) -> bool:
        """Whether it carries records."""

    def prepare(self, cover: Gaussians) -> PreparedCover:
        """Find the carriers. Raises InputError for a cover that has no room, or none that is unseen.

        Raises OutputError for a cover that the format of the published file does not hold.
        """

    def room(self, gaussians: int, sh_degree: int) -> Room:
        """About what fits into a cover of which so many Gaussians can carry something."""

    def largest_record(self, sh_degree: int) -> int:
        """Bytes of the largest record in a model of this SH degree; 0 without records or room for any."""

    def appended(self, size: int) -> int:
        """Gaussians by which the model grows for a payload of `size` bytes."""

    def reader(self, stego: Gaussians) -> Reader | None:
        """What reads this model; None where nothing can lie in it."""


class PayloadChannel:
    """Part of a `Channel` without records, in which models do not grow."""

    grows = False
    records = False

    def largest_record(self, sh_degree: int) -> int:
        return 0

    def appended(self, size: int) -> int:
        return 0


class PayloadsOnly:
    """Part of a `Room` without records."""

    grows = False

    def record_capacity(self, requests: Sequence[RecordRequest]) -> int:
        return 0

    def plan_records(self, requests: Sequence[RecordRequest]) -> list[RecordPlan]:
        raise UsageError("this channel carries payloads, not records")


@dataclass(frozen=True)
class PayloadRoom(PayloadsOnly):
    """A `Room` without records."""

    carriers: int
    capacity: int
    overhead: int
    grows: bool = False
