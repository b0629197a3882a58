"""The protocol of all channels: places in a published model where bits are stored and found with a key.

A channel finds slots for bits in a cover, writes and reads them. What they mean is the same in every channel
(see `container`): *payloads*, bytes that are read completely or not at all.

How a model is published determines its channel (`publishing`); readers try all channels.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol

from keyss.channels.container import Payload
from keyss.core.gaussians import Gaussians


@dataclass(frozen=True)
class Capacity:
    """The capacity of a cover: exact for a prepared cover, an estimate before it is fitted."""

    bytes: int  # of one payload
    overhead: int  # maximum bytes of a payload beside its data
    further: float = 1.0  # each payload after the first multiplies the bytes of all together by this
    # Shares of one payload: part of the carriers, and bytes; None: a quarter, a half and all of `bytes`.
    steps: tuple[tuple[float, int], ...] | None = None
    equal: Callable[[int], int] | None = None  # bytes of each of several equal payloads; None: equal parts
    divisible: bool = True  # False: several payloads have equal shares
    grows: bool = False  # True if the model grows with the hidden data, which should then be short


class PreparedCover(Protocol):
    """A cover with known capacity in a channel."""

    @property
    def cover(self) -> Gaussians:
        """The cover."""

    @property
    def capacity(self) -> Capacity:
        """Its capacity."""

    def embed(self, payloads: Sequence[tuple[str, Payload]], *, entropy: bytes | None = None) -> Gaussians:
        """Embed one (key, payload) per secret.

        `entropy`: at least 32 secret bytes from which all randomness is derived; by default the system's.
        Raises UsageError for equal keys and for payloads that do not fit. Warns (KeyssWarning) if the holder
        of one key can tell that there are other secrets.
        """


class Reader(Protocol):
    """Reads the secrets of a stego model from one channel."""

    def open(self, key: str) -> Payload:
        """The payload that `key` opens. Raises WrongKeyError if it opens nothing, InputError for damage."""


class Channel(ABC):
    """A place for bits in a model."""

    place: str  # in messages: "low bits", "quantised values of spz" and so on
    survives: ClassVar[bool] = False  # True if secrets survive conversion to other formats
    grows: ClassVar[bool] = False  # see `Capacity`

    @abstractmethod
    def prepare(self, cover: Gaussians) -> PreparedCover:
        """Find the carriers. Raises UsageError for a cover without capacity, or if changes would be visible.

        Raises OutputError for a cover that the published format cannot hold.
        """

    @abstractmethod
    def estimate_capacity(self, gaussians: int, sh_degree: int) -> Capacity:
        """Estimate the capacity of a cover that is not fitted yet."""
