"""Where payloads of several secrets fit whole, by the format in which a model is published.

In low bits (`ply`) they do as well, but there a model is better carried Gaussian by Gaussian.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

from keyss.channels import appended, robust
from keyss.channels.base import Payload
from keyss.channels.codes import CodesCover, published
from keyss.channels.packing import pack_payload
from keyss.core.gaussians import Gaussians

Publish = Literal["ply", "spz", "sog", "compressed-ply", "any"]
AnyChannel = Literal["appended", "colours"]  # of what is published as any format

Secrets = Sequence[tuple[str, Payload]]  # each with its key


class Room(Protocol):
    """A cover in which payloads fit whole."""

    @property
    def capacity(self) -> int:
        """Bytes of all payloads together."""

    @property
    def overhead(self) -> int:
        """Bytes that a payload takes beside its data, at most."""

    @property
    def grows(self) -> bool:
        """Whether the model grows by what is hidden, so that it should be short."""

    def embed(self, secrets: Secrets, *, entropy: bytes | None = None) -> Gaussians:
        """What is to be published. Raises UsageError for equal keys and for what does not fit."""


@dataclass(frozen=True)
class _Codes:
    cover: CodesCover
    overhead: int = 128
    grows: bool = False

    @property
    def capacity(self) -> int:
        return int(self.cover.capacity * (1 - 2**-10))  # what is packed already gets longer by less

    def embed(self, secrets: Secrets, *, entropy: bytes | None = None) -> Gaussians:
        return published.coded(self.cover.embed(secrets, entropy=entropy))


@dataclass(frozen=True)
class _Appended:
    cover: Gaussians
    capacity: int = appended.MOST_BYTES
    overhead: int = 128
    grows: bool = True

    def embed(self, secrets: Secrets, *, entropy: bytes | None = None) -> Gaussians:
        return appended.embed(self.cover, secrets, entropy=entropy)


@dataclass(frozen=True)
class _Colours:
    cover: robust.RobustCover
    strength: float
    repair: bool
    overhead: int = 16
    grows: bool = False

    @property
    def capacity(self) -> int:
        return self.cover.capacity(self.strength)

    def embed(self, secrets: Secrets, *, entropy: bytes | None = None) -> Gaussians:
        packed = [(key, pack_payload(payload)) for key, payload in secrets]
        stego = self.cover.embed(packed, strength=self.strength, entropy=entropy)
        return robust.repaired(self.cover.model, stego) if self.repair else stego


def room_in(
    cover: Gaussians,
    publish: Publish,
    channel: AnyChannel,
    *,
    strength: float = robust.STRENGTH,
    repair: bool = False,
) -> Room:
    """The room in a cover that is not published as `ply`; `strength` (dB) and `repair` are those of colours.

    Raises UsageError for a `repair` of a model without harmonics, InputError for a cover that has no room,
    OutputError for one that the format does not hold.
    """
    if publish == "any":
        if channel == "appended":
            return _Appended(cover)
        if repair:
            robust.check_repairable(cover)
        return _Colours(robust.RobustCover.of(cover), strength, repair)
    return _Codes(published.prepare(cover, publish))
