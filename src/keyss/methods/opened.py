"""What a key opens: a secret, before it is revealed. Imports nothing that hides."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Protocol

from torch import Tensor

from keyss.core.gaussians import Gaussians
from keyss.core.similarity import Similarity

Frame = Literal["secret", "cover"]


@dataclass(frozen=True)
class Remains:
    """How much of a secret a model still gives."""

    found: int  # Gaussians
    hidden: int  # Gaussians that there were; 0: not known
    chunks: tuple[int, int] | None = None  # of its payload: those left and those there were; None: no chunks
    slack: float = 0.0  # share by which the numbers may differ although nothing was lost

    @property
    def share(self) -> float:
        """Of the hidden Gaussians those found: 0 to 1, more where Gaussians were added."""
        return self.found / self.hidden if self.hidden else float(self.found > 0)

    @property
    def whole(self) -> bool:
        """Whether nothing was lost or added."""
        return abs(self.share - 1) <= self.slack and (self.chunks is None or self.chunks[0] == self.chunks[1])


class Opened(Protocol):
    """A secret as its key opens it, before it is revealed."""

    @property
    def frame(self) -> Similarity | None:
        """From the secret's own frame into the cover's; None where it was never in the cover's."""

    @property
    def decode(self) -> Callable[[Gaussians, Tensor], Gaussians] | None:
        """From a stego model and an embedding [64] to what a decoder makes of them, in the cover's frame.

        Differentiable in the embedding where the decoder is: the white-box attack goes by that gradient. None
        where keys condition no decoder, so that a wrong key shows nothing at all.
        """

    def reveal(self, stego: Gaussians, *, frame: Frame = "secret", force: bool = False) -> Gaussians:
        """The secret as a model of its own, on the CPU; `force`: also from a model that was changed.

        Raises InputError for a model that it does not belong to, UsageError for a frame that it never was in.
        """

    def remains(self, revealed: Gaussians) -> Remains:
        """How much of the secret there is in what `reveal` gave."""

    def fingerprint(self) -> str:
        """16 hexadecimal digits by which a run knows its secrets; they say nothing without the secret."""
