"""Hidden scenes and hidden files, which keys open, and companion files."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

from torch import Tensor

from keyss.channels import Payload, pack_payload, unpack_payload
from keyss.core.errors import InputError, UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.similarity import Similarity

Frame = Literal["secret", "cover"]

FILE = "file"  # method name in the payload of a file
MAX_NAME_BYTES = 255
COMPANION = ".keyss"  # suffix of a companion file
MAX_COMPANION_BYTES = 1 << 30
_MAGIC = b"keyss handed 3\0\0"


@dataclass(frozen=True)
class Recovered:
    """The part of a secret that is left in a model."""

    found: int  # Gaussians that are left
    hidden: int  # Gaussians that were hidden; 0: unknown
    shards: tuple[int, int] | None = None  # payload shards left and written; None: not divided
    slack: float = 0.0  # relative difference of `found` and `hidden` that is not a loss

    @property
    def share(self) -> float:
        """The share of the hidden Gaussians that is left; above 1 if Gaussians were added."""
        return self.found / self.hidden if self.hidden else float(self.found > 0)

    @property
    def whole(self) -> bool:
        """True if nothing was lost or added."""
        return abs(self.share - 1) <= self.slack and (self.shards is None or self.shards[0] == self.shards[1])


class HiddenScene(ABC):
    """A secret scene after its key has opened it, and before `reveal`."""

    frame: Similarity | None  # secret frame to cover frame; None if it has no position in the cover

    # The decoder: maps a stego model and a key's vector [`key_size`] to Gaussians in the cover's frame.
    # Differentiable in the vector, for white-box attacks. None if no decoder is conditioned on keys: wrong
    # keys then show nothing at all.
    decode: Callable[[Gaussians, Tensor], Gaussians] | None = None

    @property
    def key_size(self) -> int:
        """The size of a key's vector; 0 without a decoder."""
        return 0

    @abstractmethod
    def reveal(self, stego: Gaussians, *, frame: Frame = "secret") -> Gaussians:
        """The secret as a standalone model on the CPU.

        Raises InputError if it does not belong to the model, UsageError for a frame in which it has no
        position.
        """

    def recovered(self, revealed: Gaussians) -> Recovered:
        """The part of the secret that the result of `reveal` contains; by default all of it."""
        return Recovered(len(revealed), len(revealed))

    @abstractmethod
    def fingerprint(self) -> str:
        """16 hexadecimal digits that identify the secret in a run, and reveal nothing about it."""


@dataclass(frozen=True)
class HiddenFile:
    """A hidden file and its name, which is for display only, never a path."""

    name: str
    data: bytes = field(repr=False)
    shards: tuple[int, int] | None = field(default=None, compare=False)  # see `Payload`

    def payload(self) -> Payload:
        """The payload for a channel. Raises UsageError for a name longer than MAX_NAME_BYTES."""
        name = self.name.encode()
        if len(name) > MAX_NAME_BYTES:
            raise UsageError(f"expected a name of at most {MAX_NAME_BYTES} bytes, got {len(name)}")
        return Payload(FILE, bytes([len(name)]) + name + self.data)

    @staticmethod
    def of(payload: Payload) -> HiddenFile:
        """Read a payload. Raises InputError for a scene and damage."""
        if payload.method != FILE:
            raise InputError("this key opens a scene, not a file")
        size = payload.data[0] if payload.data else 0
        name, data = payload.data[1 : 1 + size], payload.data[1 + size :]
        if not payload.data or len(name) < size:
            raise InputError("the hidden file is damaged: its name is cut off")
        return HiddenFile(name.decode(errors="replace"), data, payload.shards)


def pack_companion(payload: Payload) -> bytes:
    """The bytes of a companion file: with it, the published model shows a secret without a key.

    Methods that do not store a whole secret in the published model write one per secret: 16 bytes of magic,
    then the payload.
    """
    return _MAGIC + pack_payload(payload)


def unpack_companion(data: bytes) -> Payload:
    """Invert `pack_companion`. Raises InputError."""
    if not data.startswith(_MAGIC):
        raise InputError("expected a `.keyss` file, as `keyss hide` writes for some methods")
    return unpack_payload(data[len(_MAGIC) :])
