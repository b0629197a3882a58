"""Tables of integers as few bytes: an adaptive binary range coder.

A number is coded as its difference to a share of the number before it in its column: the count of the
difference's bits in unary, its sign, and these bits. Whatever is not evenly distributed is coded by chances
that adapt, those of the count by how large differences were before in the row and in the column. The coder is
that of LZMA, with 12 instead of 11 bits for a chance: the mean of a fast and a slow estimate (as in AV1 and
CABAC's successors).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from keyss.core.arrays import Integers
from keyss.core.errors import InputError
from keyss.rendering.cpu.jit import inlined, kernel

MAX_NUMBER = 1 << 29  # differences have at most 31 bits
_MOST = 31
_CONTEXTS = 16  # contexts for counts; one more is for first bits


def encode(table: Integers, shares: Integers, groups: Integers) -> bytes:
    """`table` [N, C], no number beyond MAX_NUMBER, as bytes.

    `shares` [C]: eighths of the number before that a number is predicted to be. `groups` [C]: columns with
    the same number, from 0 on, share their chances.
    """
    coded, size = _coded(table.copy(), shares, groups, np.empty(table.size + 1024, np.uint8), False)
    return bytes(coded[:size])


def decode(data: bytes, count: int, shares: Integers, groups: Integers) -> Integers:
    """[count, C] the table of `encode`. Raises InputError for bytes that are too few or too many."""
    table = np.zeros((count, len(shares)), np.int64)
    _, size = _coded(table, shares, groups, np.frombuffer(data + b"\0", np.uint8).copy(), True)
    if size != len(data):
        raise InputError("the hidden secret is damaged: it is not whole")
    return table


@inlined
def _byte(coder: Any, data: Any, reading: bool) -> None:
    """The next byte. `coder`: low end of the range, or how far in it the data are; range; bytes so far."""
    at = coder[2]
    coder[2] += 1
    if reading:
        coder[0] = coder[0] << 8 | data[min(at, len(data) - 1)]
        return
    if coder[0] >> 32:  # a carry
        before = at - 1
        while data[before] == 255:
            data[before] = 0
            before -= 1
        data[before] += 1
    data[at] = coder[0] >> 24 & 255
    coder[0] = coder[0] << 8 & 0xFFFFFFFF


@inlined
def _bit(coder: Any, data: Any, reading: bool, bit: int, bound: int) -> int:
    """Writes a bit, or reads it; `bound`: the part of the range that belongs to 0."""
    if reading:
        bit = int(coder[0] >= bound)
    if bit:
        coder[0] += -bound if reading else bound
    coder[1] = coder[1] - bound if bit else bound
    while coder[1] < 1 << 24:
        coder[1] <<= 8
        _byte(coder, data, reading)
    return bit


@inlined
def _likely_bit(coder: Any, data: Any, reading: bool, bit: int, chance: Any) -> int:
    """The same by a chance of 0 in 65,536ths, the mean of two estimates, which learn."""
    bit = _bit(coder, data, reading, bit, (coder[1] >> 12) * ((chance[0] + chance[1]) >> 5))
    for each, speed in ((0, 4), (1, 7)):
        chance[each] += -(chance[each] >> speed) if bit else (65536 - chance[each]) >> speed
    return bit


@kernel
def _coded(table: Any, shares: Any, groups: Any, data: Any, reading: bool) -> Any:
    """The bytes of a table, or the table from bytes that a zero ends; and how many bytes were used."""
    count, columns = table.shape
    chances = np.full((groups.max() + 1, _CONTEXTS + 1, _MOST + 1, 2), 1 << 15, np.int64)
    coder = np.array([0, (1 << 32) - 1, 0], np.int64)
    for _ in range(4 * reading):
        _byte(coder, data, reading)
    before, sizes = np.zeros(columns, np.int64), np.zeros(columns, np.int64)
    for row in range(count):
        lately = 0
        if reading and coder[2] >= len(data) + 4:
            break  # nothing but the zeros after the end
        for column in range(columns):
            if not reading and len(data) - coder[2] < 256:
                data = np.concatenate((data, np.empty_like(data)))
            predicted = shares[column] * before[column] >> 3
            difference = table[row, column] - predicted
            value, size = abs(difference), 0
            own = chances[groups[column]]
            context = own[min(_CONTEXTS - 1, (sizes[column] + lately) >> 2)]
            while size < _MOST and _likely_bit(coder, data, reading, int(value >> size > 0), context[size]):
                size += 1
            negative = size > 0 and _bit(coder, data, reading, int(difference < 0), coder[1] >> 1)
            found = min(size, 1)
            if size > 1:
                found = 2 + _likely_bit(coder, data, reading, value >> (size - 2) & 1, own[_CONTEXTS, size])
            for shift in range(size - 3, -1, -1):
                found = 2 * found + _bit(coder, data, reading, value >> shift & 1, coder[1] >> 1)
            before[column] = table[row, column] = predicted + (-found if negative else found)
            sizes[column] += (4 * size - sizes[column] + 1) >> 1
            lately += (8 * size - lately + 2) >> 2
    for _ in range(4 * (not reading)):
        _byte(coder, data, reading)
    return data, coder[2]
