"""Compression of integer tables by an adaptive binary range coder.

The prediction of a number is a fraction of the previous one in its column. The residual is coded as its bit
count in unary, its sign and its bits. The count and the bit after the first have adaptive probabilities; the
context of the count is the size of earlier residuals in the row and the column. The coder is LZMA's, with
probabilities of 12 instead of 11 bits: the mean of a fast and a slow estimate (as in AV1 and successors of
CABAC).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from keyss.core.arrays import Integers
from keyss.core.errors import InputError
from keyss.kernels.jit import inline, kernel

Table = npt.NDArray[np.int32]

MAX_NUMBER = 1 << 29  # differences have at most 31 bits
_MAX_BITS = 31
_CONTEXTS = 16  # for bit counts; one more is for the bits after the first


def encode(table: Table, shares: Integers, groups: Integers) -> bytes:
    """Compress `table` [N, C] with absolute values of at most MAX_NUMBER.

    `shares` [C]: prediction coefficients of the columns, in eighths. `groups` [C]: indices from 0; columns
    with the same index share their probabilities.
    """
    coded, size = _code(table, shares, groups, np.empty(table.size + 1024, np.uint8), False)
    return bytes(coded[:size])


def decode(data: bytes, count: int, shares: Integers, groups: Integers) -> Table:
    """Decompress a table [count, C]. Raises InputError for too few or too many bytes."""
    table = np.zeros((count, len(shares)), np.int32)
    _, size = _code(table, shares, groups, np.frombuffer(data + b"\0", np.uint8).copy(), True)
    if size != len(data):
        raise InputError("the hidden secret is damaged: its length is wrong")
    return table


@inline
def _byte(coder: Any, data: Any, reading: bool) -> None:
    """Read or write a byte. `coder`: low end of the range (reading: offset into it), range, bytes so far."""
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


@inline
def _raw_bit(coder: Any, data: Any, reading: bool, bit: int, bound: int) -> int:
    """Read or write a bit; `bound`: the part of the range for 0."""
    if reading:
        bit = int(coder[0] >= bound)
    if bit:
        coder[0] += -bound if reading else bound
    coder[1] = coder[1] - bound if bit else bound
    while coder[1] < 1 << 24:
        coder[1] <<= 8
        _byte(coder, data, reading)
    return bit


@inline
def _bit(coder: Any, data: Any, reading: bool, bit: int, estimates: Any) -> int:
    """`_raw_bit` with a probability of 0 that is the mean of two adaptive `estimates` [2], in 65,536ths."""
    bit = _raw_bit(coder, data, reading, bit, (coder[1] >> 12) * ((estimates[0] + estimates[1]) >> 5))
    for each, speed in ((0, 4), (1, 7)):
        estimates[each] += -(estimates[each] >> speed) if bit else (65536 - estimates[each]) >> speed
    return bit


@kernel
def _code(table: Any, shares: Any, groups: Any, data: Any, reading: bool) -> Any:
    """Encode `table`, or decode it from zero-terminated `data`. Returns the data and its length."""
    count, columns = table.shape
    probabilities = np.full((groups.max() + 1, _CONTEXTS + 1, _MAX_BITS + 1, 2), 1 << 15, np.int64)
    coder = np.array([0, (1 << 32) - 1, 0], np.int64)
    for _ in range(4 * reading):
        _byte(coder, data, reading)
    before, sizes = np.zeros(columns, np.int64), np.zeros(columns, np.int64)
    for row in range(count):
        recent = 0
        if reading and coder[2] >= len(data) + 4:
            break  # past the end
        for column in range(columns):
            if not reading and len(data) - coder[2] < 256:
                data = np.concatenate((data, np.empty_like(data)))
            predicted = shares[column] * before[column] >> 3
            difference = np.int64(table[row, column]) - predicted
            value, size = abs(difference), 0
            own = probabilities[groups[column]]
            context = own[min(_CONTEXTS - 1, (sizes[column] + recent) >> 2)]
            while size < _MAX_BITS and _bit(coder, data, reading, int(value >> size > 0), context[size]):
                size += 1
            negative = size > 0 and _raw_bit(coder, data, reading, int(difference < 0), coder[1] >> 1)
            found = min(size, 1)
            if size > 1:
                found = 2 + _bit(coder, data, reading, value >> (size - 2) & 1, own[_CONTEXTS, size])
            for shift in range(size - 3, -1, -1):
                found = 2 * found + _raw_bit(coder, data, reading, value >> shift & 1, coder[1] >> 1)
            before[column] = predicted + (-found if negative else found)
            table[row, column] = before[column]
            sizes[column] += (4 * size - sizes[column] + 1) >> 1
            recent += (8 * size - recent + 2) >> 2
    for _ in range(4 * (not reading)):
        _byte(coder, data, reading)
    return data, coder[2]
