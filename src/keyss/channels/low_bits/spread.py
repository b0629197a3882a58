"""How an encrypted payload is spread over cells, and how much fits.

It is cut into chunks of one cell each; the chunks of a block are coded with Reed-Solomon so that the loss of
a quarter of all Gaussians, whichever they are, leaves enough of every block. All cells of the payload's share
of carriers are used: what it does not need becomes redundancy, and the number of cells tells nothing.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from keyss.channels import reed_solomon
from keyss.channels.low_bits.bits import bytes_per_gaussian
from keyss.channels.low_bits.layout import Carriers, shares
from keyss.core.errors import InputError, UsageError
from keyss.keys.encryption import encrypted_size

REMOVAL = 0.25  # share of the Gaussians that may be removed at random
FAILURE = 1e-7  # probability that a payload is lost all the same
TYPICAL_SHARE = 0.75  # Gaussians whose low bits are random, of a trained model; 0.58 to 0.94 were measured
TAG_BYTES = 6  # of a chunk's cell: one foreign cell in 2^48 fits, for a single wrong chunk spoils a payload
NUMBER_BYTES = 3  # of a chunk
MAX_BLOCKS = (1 << 24) // reed_solomon.MAX_CHUNKS

Bytes = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class Spread:
    """`blocks` codewords of `n` chunks, `k` of them data, of `chunk` bytes each. Raises ValueError."""

    blocks: int
    n: int
    k: int
    chunk: int

    def __post_init__(self) -> None:
        if not (1 <= self.blocks <= MAX_BLOCKS and 1 <= self.k <= self.n <= reed_solomon.MAX_CHUNKS):
            raise ValueError(f"impossible codewords: {self}")

    @property
    def capacity(self) -> int:
        """Bytes of data."""
        return self.blocks * self.k * self.chunk

    def encode(self, data: bytes, cells: int) -> Bytes:
        """[cells, NUMBER_BYTES + chunk] numbered chunks; those that are left over repeat the first ones."""
        blocks = np.frombuffer(data.ljust(self.capacity, b"\0"), np.uint8)
        coded = np.concatenate(
            [reed_solomon.encode(block, self.n) for block in blocks.reshape(self.blocks, self.k, self.chunk)]
        )
        numbers = np.arange(cells, dtype="<u4") % len(coded)
        return np.concatenate([numbers.view(np.uint8).reshape(-1, 4)[:, :NUMBER_BYTES], coded[numbers]], 1)

    def decode(self, chunks: Bytes, size: int) -> bytes:
        """The first `size` bytes from numbered chunks in any order. Raises InputError if too few are left."""
        if self.blocks * self.k > len(chunks):  # before there is memory for that many
            raise InputError(
                "the key is right, but too much of the model was removed: there are "
                f"{len(chunks):,} of the {self.blocks * self.k:,} chunks that are needed"
            )
        blocks: list[dict[int, Bytes]] = [{} for _ in range(self.blocks)]
        for number, chunk in zip(_numbers(chunks).tolist(), chunks[:, NUMBER_BYTES:], strict=True):
            if number < self.blocks * self.n:
                blocks[number // self.n][number % self.n] = chunk
        decoded = (reed_solomon.decode(rows, self.k, self.n) for rows in blocks)
        whole = [block for block in decoded if block is not None]
        if lost := self.blocks - len(whole):
            raise InputError(
                f"the key is right, but too much of the model was removed: {lost} of {self.blocks} "
                "blocks are lost"
            )
        return np.concatenate(whole).tobytes()[:size]

    def left(self, chunks: Bytes) -> tuple[int, int]:
        """How many of the different chunks are among these, and how many there are."""
        every = self.blocks * self.n
        numbers = np.unique(_numbers(chunks))
        return int((numbers < every).sum()), every


def _numbers(chunks: Bytes) -> npt.NDArray[np.int64]:
    """[C] the numbers of numbered chunks."""
    numbers: npt.NDArray[np.int64] = chunks[:, :NUMBER_BYTES] @ np.array([1, 1 << 8, 1 << 16])
    return numbers


def chunk_bytes(width: int) -> int:
    """Bytes of payload in one cell of a Gaussian of `width`: 0, 12, 35 and 66 at SH degrees 0 to 3."""
    return max(0, width - TAG_BYTES - NUMBER_BYTES) if Carriers(0, width).part_bytes else 0


def plan_spread(carriers: int, parts: int, width: int, size: int) -> Spread | None:
    """The most redundant way to spread `size` bytes over one of `parts` of the carriers; None: not safe."""
    chunk = chunk_bytes(width)
    left = carriers // parts - Carriers(carriers, width).header_carriers(0)
    if chunk < 1 or left < 1:
        return None
    blocks = min(-(-left // reed_solomon.MAX_CHUNKS), MAX_BLOCKS)
    n = min(left // blocks, reed_solomon.MAX_CHUNKS)
    k = max(1, -(-size // (chunk * blocks)))
    return Spread(blocks, n, k, chunk) if k <= _most_data(n, blocks) else None


def parts_alone(carriers: int, width: int, size: int) -> int:
    """In one of how many parts of the carriers there is enough room for `size` bytes: 4, or else 2."""
    return 4 if plan_spread(carriers, 4, width, size) is not None else 2


def payload_capacity(carriers: int, secrets: int = 1, width: int = 75) -> int:
    """Bytes of encrypted payload for each of `secrets` in so many carriers of `width` bytes; may be 0."""
    smallest = plan_spread(carriers, shares(secrets), width, 1)
    if smallest is None:
        return 0
    return smallest.blocks * _most_data(smallest.n, smallest.blocks) * smallest.chunk


def carriers_for(size: int, secrets: int, width: int) -> int:
    """The least number of carriers in which `size` bytes for each of `secrets` fit."""
    if chunk_bytes(width) == 0:
        raise ValueError(f"no number of carriers of {width} bytes will do")
    enough = 1 << 10
    while payload_capacity(enough, secrets, width) < size:
        enough *= 2
    return bisect_left(range(enough), size, key=lambda each: payload_capacity(each, secrets, width))


def check_payload_fits(
    compressed: int, gaussians: int, secrets: int, sh_degree: int, *, usable: float = TYPICAL_SHARE
) -> None:
    """Raise UsageError if `compressed` bytes for each secret will hardly fit into a model to be trained.

    `usable`: the share of its Gaussians whose low bits will be random.
    """
    size = encrypted_size(compressed)
    width = bytes_per_gaussian(sh_degree)
    if payload_capacity(int(gaussians * usable), secrets, width) < size:
        raise UsageError(too_small(gaussians, usable, size, secrets, width))


def too_small(gaussians: int, usable: float, size: int, secrets: int, width: int) -> str:
    """The error message for a model whose usable share of Gaussians is `usable`."""
    if chunk_bytes(width) == 0:
        return (
            f"a model whose Gaussians hold {width} bytes has no room for anything in its low bits: there are "
            "8 at SH degree 0, 21 at degree 1, and 4 less where quaternions have unit length"
        )
    need = carriers_for(size, secrets, width) / max(usable, 0.01)
    digits = max(0, len(str(int(need))) - 2)
    rounded = math.ceil(need / 10**digits) * 10**digits
    each = "" if secrets == 1 else f" for each of {secrets} secrets"
    return (
        f"a model of {gaussians:,} Gaussians is too small to carry {size:,} bytes{each} in its low bits; "
        f"{rounded:,} Gaussians would do"
    )


@lru_cache(maxsize=1024)
def _most_data(n: int, blocks: int) -> int:
    """The largest k with which all blocks survive removal with probability 1 - FAILURE; 0 if none."""
    from scipy.special import bdtrc  # takes long to load

    data = np.arange(1, n + 1)
    return int(data[bdtrc(n - data, n, REMOVAL) * blocks < FAILURE].max(initial=0))
