"""The results of opening with a key: the protocol of hidden scenes, and hidden files."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, Protocol

from torch import Tensor

from keyss.channels import Content, Payload
from keyss.core.errors import InputError, UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.similarity import Similarity

Frame = Literal["secret", "cover"]

FILE = "file"  # replaces the name of a method
MAX_NAME_BYTES = 255


@dataclass(frozen=True)
class Remains:
    """The part of a secret that is left in a model."""

    found: int  # Gaussians that are left
    hidden: int  # Gaussians that were hidden; 0: unknown
    chunks: tuple[int, int] | None = None  # payload chunks left and written; None: not divided
    slack: float = 0.0  # share by which the numbers may differ although nothing was lost

    @property
    def share(self) -> float:
        """The share of the hidden Gaussians that is left: 0 to 1, more if Gaussians were added."""
        return self.found / self.hidden if self.hidden else float(self.found > 0)

    @property
    def whole(self) -> bool:
        """True if nothing was lost or added."""
        return abs(self.share - 1) <= self.slack and (self.chunks is None or self.chunks[0] == self.chunks[1])


class Opened(Protocol):
    """A secret as its key opens it, before it is revealed."""

    @property
    def frame(self) -> Similarity | None:
        """From the secret's own frame into the cover's; None if it was never in the cover's."""

    @property
    def decode(self) -> Callable[[Gaussians, Tensor], Gaussians] | None:
        """The decoder, from a stego model and a key's vector [`key_size`] to Gaussians in the cover's frame.

        The white-box attack follows its gradient in the vector. None if keys condition no decoder: then a
        wrong key shows nothing at all.
        """

    @property
    def key_size(self) -> int:
        """Numbers of a key's vector; 0 without a decoder."""

    def reveal(self, stego: Gaussians, *, frame: Frame = "secret", force: bool = False) -> Gaussians:
        """The secret as a model of its own, on the CPU; `force`: even from a changed model.

        Raises InputError for a model that it does not belong to, UsageError for a frame that it never was in.
        """

    def remains(self, revealed: Gaussians) -> Remains:
        """The part of the secret that `reveal` gave."""

    def fingerprint(self) -> str:
        """16 hexadecimal digits that identify the secret in a run, and tell nothing about it."""


@dataclass(frozen=True)
class HiddenFile:
    """A hidden file with its former name, which is shown and never used as a path."""

    name: str
    data: bytes = field(repr=False)

    def payload(self) -> Payload:
        """The payload for a channel. Raises UsageError for a name of more than MAX_NAME_BYTES."""
        name = self.name.encode()
        if len(name) > MAX_NAME_BYTES:
            raise UsageError(f"expected a name of at most {MAX_NAME_BYTES} bytes, got {len(name)}")
        return Payload(FILE, bytes([len(name)]) + name + self.data)

    @staticmethod
    def of(content: Content) -> HiddenFile:
        """The file of a payload. Raises InputError for other content, and for damage."""
        if content.method != FILE or not isinstance(content, Payload):
            raise InputError("this key opens a scene, not a file: give it a model's name, such as secret.ply")
        size = content.data[0] if content.data else 0
        name, data = content.data[1 : 1 + size], content.data[1 + size :]
        if not content.data or len(name) < size:
            raise InputError("the hidden file is damaged: its name is cut off")
        return HiddenFile(name.decode(errors="replace"), data)


class OpensAFileError(InputError):
    """The key opens a hidden file where a scene was expected."""

    def __init__(self, file: HiddenFile) -> None:
        super().__init__(
            f"this key opens a file of {len(file.data):,} bytes, not a scene: give it a name that is not a "
            "model's"
        )
        self.file = file
