"""What every channel offers: room for bits in a published model, and finding them again with a key.

A channel knows nothing of what its bits mean. It has two services. A *payload* is bytes that come out whole
or not at all. *Records* are many small pieces of one size that are found one by one: what is lost of the
model is lost of them, and no more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from keyss.core.gaussians import Gaussians

Bytes = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class Payload:
    """Bytes that come out whole or not at all."""

    method: str  # who reads them: the name of a method, 1 to 15 ASCII characters
    data: bytes


@dataclass(frozen=True)
class Records:
    """Pieces of one size that come out one by one, in any order."""

    method: str  # who reads them: the name of a method, 1 to 15 ASCII characters
    header: bytes  # how they are to be read; comes out whole or not at all
    records: Bytes  # [R, size]
    # [C] indices of records that are embedded a second time, because losing them costs most; empty when read.
    copied: npt.NDArray[np.int64]


Content = Payload | Records


@dataclass(frozen=True)
class RecordRequest:
    """Records that somebody wants to embed, before they are encoded: their size is the channel's to choose."""

    count: int
    least_bytes: int  # of a record
    header_bytes: int


@dataclass(frozen=True)
class RecordPlan:
    """What the channel offers for a `RecordRequest`."""

    record_bytes: int  # at most so many may be used
    copies: int  # so many records may be embedded a second time


@dataclass(frozen=True)
class Capacity:
    """Room in a model, known before anything runs."""

    carriers: int  # Gaussians that can carry something
    gaussians: int  # Gaussians of the model
    payload_bytes: int  # of one payload, after compression, for each of the secrets


class Channel(Protocol):
    """A place for bits in a model."""

    name: str
    survives: tuple[str, ...]  # file formats from which `extract` still works

    def capacity(self, cover: Gaussians, secrets: int = 1) -> Capacity:
        """Room in `cover` for each of `secrets`. Raises InputError for a cover that has no such place."""

    def plan_records(self, cover: Gaussians, requests: Sequence[RecordRequest]) -> list[RecordPlan]:
        """How each request's records are to be encoded. Raises UsageError with the number that fits."""

    def embed(
        self, cover: Gaussians, contents: Sequence[tuple[str, Content]], *, entropy: bytes | None = None
    ) -> Gaussians:
        """`cover` with one (key, content) for each secret in it.

        `entropy`: at least 32 bytes that nobody else can know, from which all that is random is derived; by
        default the system's. Raises UsageError for equal keys and for what does not fit, InputError for a
        cover that cannot carry anything unseen.
        """

    def extract(self, stego: Gaussians, key: str) -> Content:
        """What `key` opens. Raises WrongKeyError when it opens nothing, InputError for what is damaged."""
