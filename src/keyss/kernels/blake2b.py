"""BLAKE2b-128 (RFC 7693) of many rows at once.

`hashlib` takes 3 microseconds for each call, one at a time in all threads; models have millions of Gaussians.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np

from keyss.core.arrays import Bytes, Words32
from keyss.kernels.jit import inline, kernel
from keyss.kernels.parallel import in_blocks

DIGEST_BYTES = 16
_ROWS = 1 << 13  # hashed at a time
_START = np.array(
    [
        0x6A09E667F3BCC908,
        0xBB67AE8584CAA73B,
        0x3C6EF372FE94F82B,
        0xA54FF53A5F1D36F1,
        0x510E527FADE682D1,
        0x9B05688C2B3E6C1F,
        0x1F83D9ABFB41BD6B,
        0x5BE0CD19137E2179,
    ],
    np.uint64,
)
_ORDERS = np.array(
    [
        [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15],
        [14, 10, 4, 8, 9, 15, 13, 6, 1, 12, 0, 2, 11, 7, 5, 3],
        [11, 8, 12, 0, 5, 2, 15, 13, 10, 14, 3, 6, 7, 1, 9, 4],
        [7, 9, 3, 1, 13, 12, 11, 14, 2, 6, 5, 10, 4, 0, 15, 8],
        [9, 0, 5, 7, 2, 4, 10, 15, 14, 1, 11, 12, 6, 8, 3, 13],
        [2, 12, 6, 10, 0, 11, 8, 3, 4, 13, 7, 5, 15, 14, 1, 9],
        [12, 5, 1, 15, 14, 13, 4, 10, 0, 7, 6, 3, 9, 2, 8, 11],
        [13, 11, 7, 14, 12, 1, 3, 9, 5, 0, 15, 4, 8, 6, 2, 10],
        [6, 15, 14, 9, 11, 3, 0, 8, 12, 2, 13, 7, 1, 4, 10, 5],
        [10, 2, 8, 4, 7, 6, 1, 5, 15, 11, 9, 14, 3, 12, 13, 0],
    ],
    np.uint8,
)


def blake2b_rows(rows: Words32, person: bytes) -> Bytes:
    """[N, DIGEST_BYTES] hashes of rows [N, W >= 1] of little-endian words; `person`: at most 16 bytes."""
    words = np.ascontiguousarray(rows, "<u4")
    start = _START.copy()
    start[0] ^= np.uint64(0x01010000 | DIGEST_BYTES)
    start[6:] ^= np.array(struct.unpack("<2Q", person.ljust(16, b"\0")), np.uint64)
    digests = np.empty((len(words), DIGEST_BYTES // 8), np.uint64)
    in_blocks(lambda low, high: _hash(words[low:high], start, digests[low:high]), len(words), _ROWS, _hash)
    return digests.astype("<u8", copy=False).view(np.uint8)


@inline
def _rotate(word: Any, bits: Any) -> Any:
    return word >> np.uint64(bits) | word << np.uint64(64 - bits)


@inline
def _mix(state: Any, a: Any, b: Any, c: Any, d: Any, x: Any, y: Any) -> None:
    state[a] += state[b] + x
    state[d] = _rotate(state[d] ^ state[a], 32)
    state[c] += state[d]
    state[b] = _rotate(state[b] ^ state[c], 24)
    state[a] += state[b] + y
    state[d] = _rotate(state[d] ^ state[a], 16)
    state[c] += state[d]
    state[b] = _rotate(state[b] ^ state[c], 63)


@kernel
def _hash(rows: Any, start: Any, hashes: Any) -> None:
    size = 4 * rows.shape[1]
    block, state, chain = np.empty(16, np.uint64), np.empty(16, np.uint64), np.empty(8, np.uint64)
    for row in range(len(rows)):
        chain[:] = start
        for at in range(0, size, 128):
            end = min(size, at + 128)
            for word in range(16):
                first = at // 4 + 2 * word
                low = np.uint64(rows[row, first]) if first < rows.shape[1] else np.uint64(0)
                high = np.uint64(rows[row, first + 1]) if first + 1 < rows.shape[1] else np.uint64(0)
                block[word] = low | high << np.uint64(32)
            state[:8] = chain
            state[8:] = _START
            state[12] ^= np.uint64(end)
            if end == size:
                state[14] = ~state[14]
            for turn in range(12):
                order = _ORDERS[turn % 10]
                for pair in range(4):
                    x, y = block[order[2 * pair]], block[order[2 * pair + 1]]
                    _mix(state, pair, 4 + pair, 8 + pair, 12 + pair, x, y)
                for pair in range(4):
                    x, y = block[order[8 + 2 * pair]], block[order[9 + 2 * pair]]
                    _mix(state, pair, 4 + (pair + 1) % 4, 8 + (pair + 2) % 4, 12 + (pair + 3) % 4, x, y)
            for word in range(8):
                chain[word] ^= state[word] ^ state[8 + word]
        hashes[row] = chain[: hashes.shape[1]]
