"""How an encrypted payload is cut into numbered chunks, with redundancy.

Chunks are coded with Reed-Solomon so that the loss of a quarter of all Gaussians, whichever they are, leaves
enough of every codeword. A payload fills all cells that it gets: those that it does not need become
redundancy, and the number of cells tells nothing.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from keyss.channels.reed_solomon import MAX_CHUNKS, Codewords
from keyss.core.arrays import Bytes, Integers

REMOVAL = 0.25  # share of the Gaussians that may be removed at random
FAILURE = 1e-7  # probability that a payload is lost all the same
NUMBER_BYTES = 3  # of a chunk
MAX_CODEWORDS = (1 << 8 * NUMBER_BYTES) // MAX_CHUNKS


def codewords_for(cells: int, chunk: int, size: int) -> Codewords | None:
    """The most redundant way to spread `size` bytes over cells with `chunk` bytes each; None: not safe."""
    if cells < 1 or chunk < 1:
        return None
    count, n = _shape(cells)
    k = max(1, -(-size // (chunk * count)))
    return Codewords(count, n, k, chunk) if k <= _most_data(n, count) else None


def largest_payload(cells: int, chunk: int) -> int:
    """The most bytes for which there are `codewords_for` so many cells."""
    if cells < 1 or chunk < 1:
        return 0
    count, n = _shape(cells)
    return count * _most_data(n, count) * chunk


def numbered_chunks(codewords: Codewords, data: bytes, cells: int) -> Bytes:
    """[cells, NUMBER_BYTES + width] numbered chunks; those that are left over repeat the first ones."""
    numbers = np.arange(cells, dtype="<u4") % codewords.chunks
    chunks = codewords.encode(data)[numbers]
    return np.concatenate([numbers.view(np.uint8).reshape(-1, 4)[:, :NUMBER_BYTES], chunks], axis=1)


def split_numbers(chunks: Bytes) -> tuple[Integers, Bytes]:
    """The numbers [C] and the data [C, width] of numbered chunks."""
    numbers: Integers = chunks[:, :NUMBER_BYTES] @ np.array([1, 1 << 8, 1 << 16])
    return numbers, chunks[:, NUMBER_BYTES:]


def _shape(cells: int) -> tuple[int, int]:
    """How many codewords of which length."""
    count = min(-(-cells // MAX_CHUNKS), MAX_CODEWORDS)
    return count, min(cells // count, MAX_CHUNKS)


@lru_cache(maxsize=1024)
def _most_data(n: int, count: int) -> int:
    """The largest k with which all codewords survive removal with probability 1 - FAILURE; 0 if none."""
    from scipy.special import bdtrc  # takes long to load

    data = np.arange(1, n + 1)
    return int(data[bdtrc(n - data, n, REMOVAL) * count < FAILURE].max(initial=0))
