"""Wet paper codes (Fridrich et al. 2005): some bits must not change, and the reader does not know which.

The bits are put in a public random order and cut into blocks. The message of a block is the product of a
public random matrix and the block, modulo 2. The reader multiplies; the writer solves for the bits that may
change ("dry").
The capacity of a block is its number of dry bits, less the few by which random matrices lack full rank.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from keyss.channels.mixing import random_order
from keyss.core.arrays import Bits, Bytes, Integers
from keyss.kernels.jit import kernel
from keyss.keys.derivation import stream

BLOCK = 1024  # bits
_SPARE = 10  # dry bits beyond a block's message: one matrix in 1000 lacks so much rank
_AT_ONCE = 1024  # blocks
_PUBLIC = bytes(32)  # seed


def places(count: int) -> Integers:
    """[B x BLOCK] indices of the bits of all blocks, a public permutation of `count` bits."""
    return random_order(_PUBLIC, "codes/order", count)[: count // BLOCK * BLOCK]


def width_of(dry: Bits) -> int:
    """Whole bytes that every block can hold; `dry` [B x BLOCK]: 1 for bits that may change."""
    return max(0, int(dry.reshape(-1, BLOCK).sum(axis=1).min(initial=BLOCK)) - _SPARE) // 8


def matrix(rate: int) -> Bits:
    """[rate, BLOCK] random bits."""
    rows = np.frombuffer(stream(_PUBLIC, "codes/matrix", rate * BLOCK // 8), np.uint8)
    return np.unpackbits(rows.reshape(rate, -1), axis=1, bitorder="little")


def read_blocks(bits: Bits) -> Bytes:
    """[B, BLOCK / 8] the messages of all blocks of `bits`, each padded with noise."""
    return np.packbits(read(bits[places(len(bits))], BLOCK), axis=1, bitorder="little")


def block_ids(count: int, model_hash: bytes) -> Bytes:
    """[count, 16] IDs of blocks: their numbers, and the `model_hash` (12 bytes)."""
    numbers = np.arange(count, dtype="<u4")[:, None].view(np.uint8)
    return np.concatenate([numbers, np.tile(np.frombuffer(model_hash, np.uint8), (count, 1))], axis=1)


def read(bits: Bits, rate: int) -> Bits:
    """[B, rate] the first bits of the messages in blocks [B x BLOCK]."""
    return _product(bits.reshape(-1, BLOCK), matrix(rate).T)


def write(bits: Bits, dry: Bits, messages: Bits) -> Bits | None:
    """[B x BLOCK] `bits` with `dry` ones changed so that `read` gives the `messages` [B, rate].

    All solutions are equally likely if dry `bits` are random. None if a block has too few dry bits.

    One elimination for all blocks: with as many columns of the matrix P as it has rows, and the others F,
    changes are x_P = P^-1 wanted + P^-1 F x_F. A block then needs an x_F by which x_P is 0 where bits stay.
    """
    pivots, others, inverse, free = _eliminate(messages.shape[1])
    if (pivots < 0).any():
        return None
    changed = _product(messages ^ read(bits, messages.shape[1]), inverse.T)
    blocks, may = bits.reshape(-1, BLOCK).copy(), dry.reshape(-1, BLOCK) == 1
    rest = np.zeros((len(blocks), len(others)), np.uint8)
    for writable, wanted, remainder in zip(may, changed, rest, strict=True):
        stay, inside = ~writable[pivots], np.flatnonzero(writable[others])
        system = np.concatenate([free[stay][:, inside], wanted[stay, None]], axis=1)
        system, columns = _reduced(system, len(inside))
        if system[columns < 0, -1].any():
            return None
        remainder[inside[columns[columns >= 0]]] = system[columns >= 0, -1]
    blocks[:, pivots] ^= changed ^ _product(rest, free.T)
    blocks[:, others] ^= rest
    return blocks.reshape(-1)


@lru_cache(maxsize=1)
def _eliminate(rate: int) -> tuple[Integers, Integers, Bits, Bits]:
    """Columns of P (-1: none) and of F in `matrix`, P^-1 [rate, rate] and P^-1 F; see `write`."""
    rows = np.concatenate([matrix(rate), np.eye(rate, dtype=np.uint8)], axis=1)
    reduced, pivots = _reduced(rows, BLOCK)
    others = np.setdiff1d(np.arange(BLOCK), pivots)
    return pivots, others, reduced[:, BLOCK:], reduced[:, others]


def _product(left: Bits, right: Bits) -> Bits:
    """[A, C] of [A, B] and [B, C], modulo 2."""
    columns = right.astype(np.float32)  # exact: sums of at most BLOCK ones
    parts = [left[at : at + _AT_ONCE].astype(np.float32) @ columns for at in range(0, len(left), _AT_ONCE)]
    every = np.concatenate([np.empty((0, right.shape[1]), np.float32), *parts])
    return (every.astype(np.int32) & 1).astype(np.uint8)


def _reduced(rows: Bits, count: int) -> tuple[Bits, Integers]:
    """Eliminate modulo 2: the rows, and the pivot column of each [R] among the first `count` columns.

    -1 for rows that become 0 there.
    """
    packed = np.packbits(rows, axis=1)
    columns: Integers = _eliminate_packed(packed, count)
    return np.unpackbits(packed, axis=1, count=rows.shape[1]), columns


@kernel
def _eliminate_packed(matrix, count):  # type: ignore[no-untyped-def]
    """`_reduced` in place, with eight columns to a byte, the first in its highest bit."""
    columns = np.full(len(matrix), -1)
    for row in range(len(matrix)):
        for column in range(count):
            byte, bit = column >> 3, np.uint8(128 >> (column & 7))
            if matrix[row, byte] & bit:
                columns[row] = column
                for other in range(len(matrix)):
                    if other != row and matrix[other, byte] & bit:
                        for at in range(matrix.shape[1]):  # takes a fifth of what slices do
                            matrix[other, at] ^= matrix[row, at]
                break
    return columns
