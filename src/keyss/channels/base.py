"""The protocol of all channels: places in a published model where bits are stored and found with a key.

A channel finds slots for bits in a cover, writes and reads them; `container` says what they mean. How a model
is published determines its channel (`publishing`); readers try all channels.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from keyss.channels.container import Payload, warn_of_others
from keyss.core.gaussians import Gaussians


def first_shares(shares: Sequence[tuple[float, int]], sizes: Sequence[int]) -> list[int] | None:
    """For each size, the index of the first of `shares` that holds it; None if they exceed the whole.

    `shares`: part of the whole capacity, and bytes that it holds, in ascending order. The share of a secret
    depends on its own size only: otherwise its key would reveal that there are others.
    """
    chosen = [next((i for i, (_, most) in enumerate(shares) if size <= most), None) for size in sizes]
    fitting = [index for index in chosen if index is not None]
    if len(fitting) < len(sizes) or sum(shares[index][0] for index in fitting) > 1:
        return None
    return fitting


@dataclass(frozen=True)
class Capacity:
    """The capacity of a cover, in bytes of data: exact for a prepared cover, an estimate for others."""

    shares: tuple[tuple[float, int], ...]  # possible shares of a payload; see `first_shares`
    equal: Callable[[int], int]  # bytes of each of several payloads with equal shares
    grows: bool = False  # True if the model grows with the hidden data, which should then be short

    @staticmethod
    def of_sealed(
        overhead: int, shares: Sequence[tuple[float, int]], equal: Callable[[int], int], grows: bool = False
    ) -> Capacity:
        """The capacity for data, from that for sealed payloads: they take up to `overhead` bytes more."""
        payload_shares = tuple((part, max(0, size - overhead)) for part, size in shares)
        return Capacity(payload_shares, lambda count: max(0, equal(count) - overhead), grows)

    @property
    def bytes(self) -> int:
        """Maximum bytes of one payload."""
        return self.shares[-1][1]

    def limits(self, needed: Sequence[int], *, warn: bool = False) -> list[int]:
        """Maximum bytes of payloads that need `needed` bytes: of the first share that holds each.

        If these shares exceed the whole, they are equal. `warn`: warn (KeyssWarning) if a payload then gets
        fewer bytes than it would alone.
        """
        chosen = first_shares(self.shares, [min(size, self.bytes) for size in needed])
        if chosen is not None:
            return [self.shares[index][1] for index in chosen]
        limit = self.equal(len(needed))
        if warn and any(limit < min(size, self.limits([size])[0]) for size in needed):
            warn_of_others()
        return [limit] * len(needed)


class PreparedCover(Protocol):
    """A cover with known capacity in a channel."""

    @property
    def cover(self) -> Gaussians: ...

    @property
    def capacity(self) -> Capacity: ...

    def embed(self, payloads: Sequence[tuple[str, Payload]], *, entropy: bytes | None = None) -> Gaussians:
        """Embed one (key, payload) per secret.

        `entropy`: at least 32 secret bytes from which all randomness is derived; by default the system's.
        Raises UsageError for equal keys and for payloads that do not fit. Warns (KeyssWarning) if the holder
        of one key can tell that there are other secrets.
        """


@dataclass
class Channel:
    """A place for bits in a model."""

    place: str  # in messages: "low bits", "quantised values of spz" and so on
    # Finds the carriers of a cover. Raises UsageError for one without capacity, or if changes would be
    # visible, OutputError for one that the published format cannot hold.
    prepare: Callable[[Gaussians], PreparedCover]
    estimate_capacity: Callable[[int, int], Capacity]  # of so many Gaussians of an SH degree, not fitted yet
    survives: bool = False  # True if secrets survive conversion to other formats
