"""The division of carriers between secrets in low bits, and the messages of a header.

A secret has a *header* of short messages (see `shards`), its data key for each salt and its parameters, and
shards in all carriers of its share, whose number does not reveal the size of the payload.

A *share* is a part of the carriers at a depth. A key must not reveal whether there are other secrets, so a
secret's share depends on its own size only: the first that holds it of a quarter, a half and all of the
carriers at the least depth, and all of them at each larger one. Places for the headers of four secrets are
reserved, however many there are. Secrets whose shares do not fit together get equal ones at the least depth
at which they fit, by which the holder of one key can notice others.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from keyss.channels.base import Capacity, first_shares
from keyss.channels.container import MAX_OVERHEAD, PARAMETER_BYTES, Parameters
from keyss.channels.foreign import EXACT_BYTES
from keyss.channels.lsb.bits import DEEPEST, DEPTHS, LEAST, Layout
from keyss.channels.lsb.salts import SALTS
from keyss.channels.lsb.shards import Message, false_shards, groups_of, is_tagged, shard_bytes, whole_groups
from keyss.channels.reed_solomon import LOST, Codewords
from keyss.core.errors import InputError, UsageError

DATA_KEY_BYTES = 16
# Places of each fragment of a data key, for each salt, and of each fragment of the parameters. A reader needs
# two: with 60 % of the Gaussians usable and a quarter lost, fewer are left in 0.8 % and 1e-5 % of files.
_KEY_COPIES, _PARAMETER_COPIES = 12, 32
TYPICAL_SHARE = 0.75  # usable Gaussians of a trained model; 0.40 to 1.00 were measured

MAX_INDEPENDENT = 4  # maximum number of secrets with independent shares
_MAX_RESERVED = 1 / 3  # maximum share of the carriers reserved for headers
_REMOVAL = 0.25  # share of the Gaussians that may be removed at random
_FAILURE = 1e-7  # probability of losing a payload to such removal
_LONGEST = 1024  # shards per codeword; longer codewords hold little more and are slower
_SPREAD = 4  # standard deviations by which a group may be smaller than the mean
_FALSE_COST = 1.5  # shards that a false one costs: one that it contradicts, or two where it is an error
MAX_CODEWORDS = 1 << 14

# Bytes of a sealed payload beside its data, at most.
OVERHEAD = MAX_OVERHEAD + EXACT_BYTES


@dataclass(frozen=True)
class Share:
    """Carriers of a secret at a depth, and the codewords in them."""

    part: float  # share of all carriers
    carriers: int
    depth: int
    codewords: Codewords

    def holding(self, size: int) -> Share:
        """The same carriers with the most redundant codewords for `size` bytes."""
        k = max(1, -(-size // (self.codewords.width * self.codewords.count)))
        return replace(self, codewords=replace(self.codewords, k=k))


@dataclass(frozen=True)
class Allocation:
    """The division of carriers between payloads."""

    depth: int
    shares: list[Share]  # one per payload
    independent: bool  # True if no share depends on other secrets


@dataclass(frozen=True)
class LowBitsCapacity:
    """The capacity of the low bits of a model of `gaussians`, so many of them `carriers`, up to `depth`."""

    gaussians: int
    carriers: int
    layout: Layout
    depth: int = DEEPEST

    @staticmethod
    def of(gaussians: int, layout: Layout) -> LowBitsCapacity:
        """An estimate."""
        return LowBitsCapacity(gaussians, int(TYPICAL_SHARE * gaussians), layout)

    def for_payloads(self) -> Capacity:
        shares = _sizes(self._shares) or [(1.0, self.payload_capacity(1))]
        return Capacity.of_sealed(OVERHEAD, shares, self.payload_capacity)

    @property
    def header_carriers(self) -> int:
        """Gaussians that the header of a secret takes at most."""
        width = self.layout.width(LEAST)
        return SALTS * key_message(b"", width).places + parameter_message(b"", width).places

    def plan(self, sizes: Sequence[int]) -> Allocation:
        """Shares for sealed payloads of `sizes` bytes.

        Raises UsageError, with the number of Gaussians that would suffice.
        """
        shares = self._shares if len(sizes) <= MAX_INDEPENDENT else []
        chosen: list[Share | None] = [shares[index] for index in first_shares(_sizes(shares), sizes) or []]
        independent = bool(chosen)
        if not independent:
            equal = (share for share in self._equal(len(sizes)) if share.codewords.size >= max(sizes))
            chosen = [next(equal, None)] * len(sizes)
        filled = [share.holding(size) for share, size in zip(chosen, sizes, strict=True) if share]
        if not filled:
            raise UsageError(self.too_small(max(sizes), len(sizes)))
        return Allocation(max(share.depth for share in filled), filled, independent)

    def payload_capacity(self, secrets: int) -> int:
        """Maximum bytes of each of `secrets` sealed payloads with equal shares; may be 0."""
        return max((share.codewords.size for share in self._equal(secrets)), default=0)

    def too_small(self, size: int, secrets: int) -> str:
        """The message for payloads of `size` bytes that do not fit."""

        def capacity(gaussians: int) -> int:
            carriers = gaussians * self.carriers // max(1, self.gaussians)
            return replace(self, gaussians=gaussians, carriers=carriers).payload_capacity(secrets)

        need = bisect_left(range(_LONGEST * MAX_CODEWORDS), size, key=capacity)
        digits = max(0, len(str(need)) - 2)
        rounded = math.ceil(need / 10**digits) * 10**digits
        per_secret = "" if secrets == 1 else f" for each of {secrets} secrets"
        return (
            f"a cover of {self.gaussians:,} Gaussians is too small to carry {size:,} bytes{per_secret} in "
            f"its low bits; {rounded:,} Gaussians would do"
        )

    @property
    def _depths(self) -> list[int]:
        return [depth for depth in DEPTHS if depth <= self.depth]

    @property
    def _shares(self) -> list[Share]:
        """The shares that a secret may get, in the order of capacity.

        Empty if the headers of four secrets would take too many carriers.
        """
        reserved, shares = MAX_INDEPENDENT * self.header_carriers, list[Share]()
        if reserved > _MAX_RESERVED * self.carriers:
            return []
        for part, depth in ((0.25, LEAST), (0.5, LEAST), *((1.0, depth) for depth in self._depths)):
            share = self._share(part, int(part * (self.carriers - reserved)), depth)
            if share and (not shares or share.codewords.size > shares[-1].codewords.size):
                shares.append(share)
        return shares

    def _equal(self, secrets: int) -> list[Share]:
        """Equal shares of `secrets`, at each depth."""
        count = self.carriers // secrets - self.header_carriers
        shares = [self._share(1 / secrets, count, depth) for depth in self._depths]
        return [share for share in shares if share]

    def _share(self, part: float, count: int, depth: int) -> Share | None:
        """The share of `count` carriers at a depth, with the most data that survives.

        None if even the least has a probability of loss above _FAILURE.
        """
        width = self.layout.width(depth)
        shard, tagged = shard_bytes(width), is_tagged(width)
        number = whole_groups(-(-count // _LONGEST), tagged) if count > 0 else 0
        if shard < 1 or not 0 < number <= MAX_CODEWORDS:
            return None
        groups = groups_of(number, tagged)
        mean = count / groups
        n = int((mean if groups == 1 else mean - _SPREAD * mean**0.5) * groups / number)
        lost = _REMOVAL + _FALSE_COST * false_shards(self.gaussians - count, groups, tagged)
        most = _most_data(n, number, round(lost, 4))
        return Share(part, count, depth, Codewords(number, n, most, shard)) if most else None


def _sizes(shares: Sequence[Share]) -> list[tuple[float, int]]:
    return [(share.part, share.codewords.size) for share in shares]


def check_payload_fits(compressed: int, gaussians: int, secrets: int, sh_degree: int) -> None:
    """Raise UsageError if `compressed` bytes per secret will probably not fit into a model to be trained."""
    size, capacity = compressed + OVERHEAD, LowBitsCapacity.of(gaussians, Layout(sh_degree))
    if capacity.payload_capacity(secrets) < size:
        raise UsageError(capacity.too_small(size, secrets))


def key_message(secret: bytes, width: int) -> Message:
    """The message of a data key under the secret of a key, in rows of `width` bytes at the least depth."""
    return Message(secret, "key", DATA_KEY_BYTES, min(width, DATA_KEY_BYTES), _KEY_COPIES)


def parameter_message(data_key: bytes, width: int) -> Message:
    """The message of the parameters, in rows of `width` bytes at the least depth."""
    return Message(data_key, "parameters", PARAMETER_BYTES, width, _PARAMETER_COPIES)


def codewords_of(parameters: Parameters, layout: Layout) -> Codewords:
    """The codewords that parameters describe. Raises InputError for impossible ones."""
    depth, count, n, k = parameters.depth, parameters.count, parameters.n, parameters.k
    try:
        width = layout.width(depth) if depth in DEPTHS else 0
        whole = 0 < count <= MAX_CODEWORDS and count == whole_groups(count, is_tagged(width))
        if not whole or n > _LONGEST or shard_bytes(width) < 1:
            raise ValueError(f"{count} codewords of {n} shards at depth {depth}")
        return Codewords(count, n, k, shard_bytes(width))
    except ValueError as error:
        raise InputError(f"the hidden parameters are damaged: {error}; {LOST}") from error


@lru_cache(maxsize=4096)
def _most_data(n: int, count: int, lost: float) -> int:
    """The largest k with which all codewords survive, each shard being lost with a probability; 0 if none."""
    from scipy.special import bdtrc  # takes long to load

    data = np.arange(1, n + 1)
    return int(data[bdtrc(n - data, n, lost) * count < _FAILURE].max(initial=0)) if lost < 1 else 0
