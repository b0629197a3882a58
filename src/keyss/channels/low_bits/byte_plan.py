"""How much fits into a model's cells, and how it is spread over them.

A payload is cut into chunks of one cell each; the chunks of a block are coded with Reed-Solomon so that the
loss of a quarter of all Gaussians, whichever they are, leaves enough of every block. All cells that a secret
may use are used: what the payload does not need becomes redundancy, and their number tells nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

from scipy.stats import binom

from keyss.channels.low_bits.bits import bytes_per_gaussian
from keyss.channels.low_bits.byte_cells import OVERHEAD
from keyss.channels.low_bits.reed_solomon import MAX_CHUNKS
from keyss.core.errors import UsageError
from keyss.keys.sealed import sealed_size

REMOVAL = 0.25  # share of the Gaussians that may be removed at random
FAILURE = 1e-7  # probability that a payload is lost all the same
SALTS = 12  # Gaussians that may serve as the salt: all are removed with probability 6e-8
COPIES = 12  # of every header cell: all are removed with probability 6e-8
SHARES = 2  # a secret uses one in so many cells; one in four where there are three or four, and so on
TYPICAL_SHARE = 0.75  # Gaussians whose low bits are random, of a trained model; 0.58 to 0.94 were measured

_HEADER_BYTES = 41  # data key, length, blocks, chunks of a block, data chunks of a block
MAX_BLOCKS = (1 << 24) // MAX_CHUNKS


@dataclass(frozen=True)
class Plan:
    """`blocks` codewords of `n` chunks, `k` of them data, of `chunk` bytes each."""

    blocks: int
    n: int
    k: int
    chunk: int

    def __post_init__(self) -> None:
        if not (1 <= self.blocks <= MAX_BLOCKS and 1 <= self.k <= self.n <= MAX_CHUNKS):
            raise ValueError(f"no such plan: {self}")

    @property
    def capacity(self) -> int:
        return self.blocks * self.k * self.chunk


def shares(secrets: int) -> int:
    """Into how many parts the cells are divided: the power of two from `secrets` on, at least 2."""
    return max(SHARES, 1 << (secrets - 1).bit_length())


def chunk_bytes(sh_degree: int) -> int:
    """Bytes of payload in one cell: 0, 12, 35 and 66 at degrees 0 to 3."""
    return max(0, bytes_per_gaussian(sh_degree) - OVERHEAD)


def header_parts(sh_degree: int) -> int:
    """Cells that one copy of the header takes: 1 at degree 3."""
    return -(-_HEADER_BYTES // chunk_bytes(sh_degree))


def header_cells(sh_degree: int) -> int:
    """Cells of a secret's share that all copies of its header take."""
    return SALTS * COPIES * header_parts(sh_degree)


def plan(cells: int, secrets: int, sh_degree: int, size: int) -> Plan | None:
    """The most redundant way to spread `size` bytes for each of `secrets`; None if it would not be safe."""
    chunk = chunk_bytes(sh_degree)
    if chunk < 1:
        return None
    left = cells // shares(secrets) - header_cells(sh_degree)
    if left < 1:
        return None
    blocks = min(-(-left // MAX_CHUNKS), MAX_BLOCKS)
    n = min(left // blocks, MAX_CHUNKS)
    k = max(1, -(-size // (chunk * blocks)))
    return Plan(blocks, n, k, chunk) if k <= _most_data(n, blocks) else None


def capacity(cells: int, secrets: int = 1, sh_degree: int = 3) -> int:
    """Bytes of sealed payload for each of `secrets` in a model with `cells` usable Gaussians; may be 0."""
    smallest = plan(cells, secrets, sh_degree, 1)
    if smallest is None:
        return 0
    return smallest.blocks * _most_data(smallest.n, smallest.blocks) * smallest.chunk


def cells_for(size: int, secrets: int, sh_degree: int) -> int:
    """The least number of cells in which `size` bytes for each of `secrets` fit. `sh_degree`: 1 to 3."""
    if chunk_bytes(sh_degree) == 0:
        raise ValueError(f"no number of cells will do for SH degree {sh_degree}")
    low, high = 0, 1 << 10
    while capacity(high, secrets, sh_degree) < size:
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if capacity(middle, secrets, sh_degree) >= size else (middle, high)
    return high


def check_room(compressed: int, gaussians: int, secrets: int, sh_degree: int) -> None:
    """Raise UsageError if `compressed` bytes for each secret will hardly fit into a model to be trained."""
    size = sealed_size(compressed)
    if capacity(int(gaussians * TYPICAL_SHARE), secrets, sh_degree) < size:
        raise UsageError(too_small(gaussians, TYPICAL_SHARE, size, secrets, sh_degree))


def too_small(gaussians: int, usable: float, size: int, secrets: int, sh_degree: int) -> str:
    """What to tell the owner of a model of which a share `usable` can be used."""
    if chunk_bytes(sh_degree) == 0:
        return (
            "a model without spherical harmonics has no room for anything in its low bits; "
            "--sidecar writes a file beside it"
        )
    need = cells_for(size, secrets, sh_degree) / max(usable, 0.01)
    digits = max(0, len(str(int(need))) - 2)
    rounded = math.ceil(need / 10**digits) * 10**digits
    each = "" if secrets == 1 else f" for each of {secrets} secrets"
    return (
        f"a model of {gaussians:,} Gaussians is too small to carry {size:,} bytes{each} in its low bits; "
        f"{rounded:,} Gaussians (--max-gaussians) would do, or --sidecar, which writes a file beside it"
    )


@lru_cache(maxsize=1024)
def _most_data(n: int, blocks: int) -> int:
    """The largest k with which all blocks survive removal with probability 1 - FAILURE; 0 if none."""
    for k in range(n, 0, -1):
        if binom.sf(n - k, n, REMOVAL) * blocks < FAILURE:
            return k
    return 0
