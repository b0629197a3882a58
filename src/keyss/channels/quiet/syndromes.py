"""Wet paper codes (Fridrich, Goljan, Lisonek and Soukal 2005): some bits must stay, unknown to the reader.

The bits, in a public random order, are cut into blocks. A block holds its product with a public random
matrix, modulo 2. The writer solves for the bits that may change ("dry"); the reader multiplies. A block holds
as many bits as it has dry ones, less the few that random matrices lack in rank.
"""

from __future__ import annotations

import numpy as np

from keyss.core.arrays import Bits, Bytes, Integers, Words
from keyss.keys.derivation import stream
from keyss.rendering.cpu.jit import kernel

BLOCK = 1024  # bits
_WORDS = BLOCK // 64
_SPARE = 10  # dry bits beyond those that a block holds: one matrix in 1000 lacks as much in rank
_AT_ONCE = 1024  # blocks
_PUBLIC = bytes(32)  # seed


def places(count: int) -> Integers:
    """[B BLOCK] which of `count` bits are those of the blocks, one block after the other."""
    numbers = np.frombuffer(stream(_PUBLIC, "codes/order", 8 * count), "<u8")
    # Sorted with their numbers in the lower half: the same on all machines, and faster than `argsort`.
    lower = np.uint64(2**32 - 1)
    order = (np.sort(numbers & ~lower | np.arange(count, dtype=np.uint64)) & lower).astype(np.int64)
    return order[: count // BLOCK * BLOCK]


def width_of(dry: Bits) -> int:
    """Whole bytes that each of the blocks [B BLOCK] holds; `dry`: 1 for bits that may change."""
    return max(0, int(dry.reshape(-1, BLOCK).sum(axis=1).min(initial=BLOCK)) - _SPARE) // 8


def matrix(rate: int = BLOCK) -> Words:
    """[rate, BLOCK / 64] random bits, 64 to a word."""
    return np.frombuffer(stream(_PUBLIC, "codes/matrix", rate * BLOCK // 8), "<u8").reshape(rate, _WORDS)


def held(bits: Bits) -> Bytes:
    """[B, BLOCK / 8] what each block of all `bits` holds, and as much noise as it could not hold."""
    product = read(bits[places(len(bits))], matrix())
    return np.packbits(product, bitorder="little").reshape(-1, BLOCK // 8)


def block_names(count: int) -> Bytes:
    """[count, 16] the identities of blocks: their numbers."""
    numbers = np.zeros((count, 4), "<u4")
    numbers[:, 0] = np.arange(count)
    return numbers.view(np.uint8)


def read(bits: Bits, rows: Words) -> Bits:
    """[B rate] the message in blocks [B BLOCK]."""
    return _product(bits.reshape(-1, BLOCK), _unpacked(rows).T).reshape(-1)


def write(bits: Bits, dry: Bits, message: Bits, rows: Words) -> Bits | None:
    """[B BLOCK] `bits` with `dry` ones changed so that `read` gives the `message` [B rate].

    All solutions are equally likely if dry bits were random. None if a block has too few of them.

    One elimination for all blocks: with as many columns of the matrix P as it has rows, and the others F,
    changes are x_P = P^-1 wanted + P^-1 F x_F. A block then needs an x_F by which x_P is 0 where bits stay.
    """
    rate = len(rows)
    identity = np.packbits(np.eye(rate, -(-rate // 64) * 64, dtype=np.uint8), axis=1, bitorder="little")
    reduced = np.concatenate([rows, identity.view(np.uint64)], axis=1)
    pivots = _eliminated(reduced, _WORDS)
    if (pivots < 0).any():
        return None
    left, inverse = np.split(_unpacked(reduced), [BLOCK], axis=1)
    others = np.setdiff1d(np.arange(BLOCK), pivots)
    wanted = (message ^ read(bits, rows)).reshape(-1, rate)
    changed = _product(wanted, inverse[:, :rate].T)
    blocks, may = bits.reshape(-1, BLOCK).copy(), dry.reshape(-1, BLOCK) == 1
    free = np.ascontiguousarray(left[:, others])  # P^-1 F
    rest = np.zeros((len(blocks), len(others)), np.uint8)
    if not _solve(free, np.ascontiguousarray(free.T), may[:, pivots], may[:, others], changed, rest):
        return None
    blocks[:, pivots] ^= changed
    blocks[:, others] ^= rest
    return blocks.reshape(-1)


def _product(left: Bits, right: Bits) -> Bits:
    """[A, C] of [A, B] and [B, C], modulo 2."""
    columns = right.astype(np.float32)  # exact: sums of at most BLOCK ones
    parts = [left[at : at + _AT_ONCE].astype(np.float32) @ columns for at in range(0, len(left), _AT_ONCE)]
    every = np.concatenate([np.empty((0, right.shape[1]), np.float32), *parts])
    return (every.astype(np.int32) & 1).astype(np.uint8)


def _unpacked(rows: Words) -> Bits:
    return np.unpackbits(rows.view(np.uint8).reshape(len(rows), -1), axis=1, bitorder="little")


@kernel
def _eliminated(own, words):  # type: ignore[no-untyped-def]
    """Reduce the rows `own` [rate, W], so that in column pivots[i] of the first `words` only row i is 1.

    The pivots; -1 from the first row on that is 0.
    """
    pivots = np.full(len(own), -1)
    one = np.uint64(1)
    for row in range(len(own)):
        word = 0
        while word < words and own[row, word] == 0:
            word += 1
        if word == words:
            break
        place = np.uint64(0)
        while (own[row, word] >> place) & one == 0:
            place += one
        pivots[row] = 64 * word + np.int64(place)
        for other in range(len(own)):
            if other != row and (own[other, word] >> place) & one:
                for at in range(word, own.shape[1]):  # loops take a fifth of what slices do
                    own[other, at] ^= own[row, at]
    return pivots


@kernel
def _solve(free, columns, may, rest_may, changed, rest):  # type: ignore[no-untyped-def]
    """Find `rest` [B, F], 0 except where `rest_may`: `changed` [B, R] + free rest is 0 except where `may`.

    `free` [R, F], `columns` its transpose. `changed` becomes the sum. False where there is none.
    """
    count = len(columns)
    own, goal = np.empty((len(free), count), np.uint8), np.empty(len(free), np.uint8)
    pivots = np.empty(len(free), np.int64)
    for block in range(len(changed)):
        number = 0
        for row in range(len(free)):
            if not may[block, row]:
                own[number], goal[number] = free[row] * rest_may[block], changed[block, row]
                number += 1
        for row in range(number):
            pivots[row] = -1
            for column in range(count):
                if own[row, column]:
                    pivots[row] = column
                    break
            if pivots[row] < 0:
                if goal[row]:
                    return False
                continue
            for other in range(number):
                if other != row and own[other, pivots[row]]:
                    own[other] ^= own[row]
                    goal[other] ^= goal[row]
        for row in range(number):
            if pivots[row] >= 0 and goal[row]:
                rest[block, pivots[row]] = 1
                changed[block] ^= columns[pivots[row]]
    return True
