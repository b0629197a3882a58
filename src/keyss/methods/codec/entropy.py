"""Compression of integer tables by an adaptive binary range coder.

The prediction of a number is a fraction of the previous one in its column. The residual is coded as its bit
count, its sign and its bits. The expected bit count follows from earlier residuals in the row and the column:
binary decisions lead from it to the bit count. They and the bit after the first have adaptive probabilities,
which depend on the expectation. The coder is LZMA's, with probabilities of 12 instead of 11 bits: the mean of
a fast and a slow estimate (as in AV1 and successors of CABAC).
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
_CONTEXTS = 48  # expected bit counts, in thirds
_FLAT_BITS = 12  # bits of equal probability that are coded at once
_LARGEST = 64  # maximum bytes of a number


def encode(table: Table, shares: Integers, groups: Integers) -> bytes:
    """Compress `table` [N, C] with absolute values of at most MAX_NUMBER.

    `shares` [C]: prediction coefficients of the columns, in eighths. `groups` [C]: indices from 0; columns
    with the same index share their probabilities.
    """
    data, size = np.empty(0, np.uint8), 0
    while size == len(data):
        data = np.empty(2 * len(data) + 2 * table.size + 1024, np.uint8)
        size = write(table, shares, groups, data)
    return data[:size].tobytes()


def decode(data: bytes, count: int, shares: Integers, groups: Integers) -> Table:
    """Decompress a table [count, C]. Raises InputError for too few or too many bytes."""
    table = np.zeros((count, len(shares)), np.int32)
    if read(table, shares, groups, np.frombuffer(data, np.uint8).copy()) != len(data):
        raise InputError("the hidden secret is damaged: its length is wrong")
    return table


@kernel
def write(table: Any, shares: Any, groups: Any, data: Any) -> Any:
    """Encode `table` into `data`; returns the number of bytes, or that of `data` if it is too small."""
    estimates = np.full((groups.max() + 1, _CONTEXTS + 1, _MAX_BITS + 1, 2), 1 << 15, np.uint16)
    return _code(table, shares, groups, data, False, estimates, np.zeros((2, len(shares)), np.int64))


@kernel
def read(table: Any, shares: Any, groups: Any, data: Any) -> Any:
    """Decode `table` from `data`; returns the bytes read, more than there are if too few."""
    estimates = np.full((groups.max() + 1, _CONTEXTS + 1, _MAX_BITS + 1, 2), 1 << 15, np.uint16)
    return _code(table, shares, groups, data, True, estimates, np.zeros((2, len(shares)), np.int64))


# The state of the coder is the low end of the range (reading: offset into it), the range, and bytes so far.


@inline
def _renormalise(low: Any, scope: Any, at: Any, data: Any, reading: bool) -> Any:
    """Read or write bytes until the range has 25 bits or more."""
    while scope < 1 << 24:
        if reading:
            low = low << 8 | (np.int64(data[at]) if at < len(data) else np.int64(0))
        else:
            if low >> 32:  # a carry
                before = at - 1
                while data[before] == 255:
                    data[before] = 0
                    before -= 1
                data[before] += 1
            data[at] = low >> 24 & 255
            low = low << 8 & 0xFFFFFFFF
        scope <<= 8
        at += 1
    return low, scope, at


@inline
def _bit(low: Any, scope: Any, at: Any, data: Any, reading: bool, bit: Any, estimates: Any) -> Any:
    """Code a bit by its probability of 0, in 65,536ths: the mean of two adaptive `estimates` [2]."""
    fast, slow = np.int64(estimates[0]), np.int64(estimates[1])
    bound = (scope >> 12) * ((fast + slow) >> 5)
    if reading:
        bit = np.int64(low >= bound)
    if bit:
        low += -bound if reading else bound
        scope -= bound
        estimates[0], estimates[1] = fast - (fast >> 4), slow - (slow >> 7)
    else:
        scope = bound
        estimates[0], estimates[1] = fast + ((65536 - fast) >> 4), slow + ((65536 - slow) >> 7)
    low, scope, at = _renormalise(low, scope, at, data, reading)
    return low, scope, at, bit


@inline
def _code(table: Any, shares: Any, groups: Any, data: Any, reading: bool, estimates: Any, state: Any) -> Any:
    """Encode `table`, or decode it. `estimates`, `state`: initial ones."""
    count, columns = table.shape
    before, sizes = state
    low, scope, at = np.int64(0), np.int64((1 << 32) - 1), np.int64(0)
    for _ in range(4 * reading):
        low, _, at = _renormalise(low, np.int64(1 << 16), at, data, reading)
    for row in range(count):
        recent = np.int64(0)
        if at >= len(data) + 4 if reading else at > len(data) - _LARGEST * columns:
            return len(data) + reading
        for column in range(columns):
            predicted = shares[column] * before[column] >> 3
            difference = np.int64(table[row, column]) - predicted
            value = abs(difference)
            context = min(_CONTEXTS - 1, (sizes[column] + recent) >> 2)
            group = groups[column]
            estimate = estimates[group, context]
            size = context // 3
            low, scope, at, more = _bit(low, scope, at, data, reading, value >> size > 0, estimate[size])
            if more:
                size += 1
                while size < _MAX_BITS and more:
                    low, scope, at, more = _bit(
                        low, scope, at, data, reading, value >> size > 0, estimate[size]
                    )
                    size += more
            else:
                while size > 0 and not more:
                    low, scope, at, more = _bit(
                        low, scope, at, data, reading, value >> (size - 1) > 0, estimate[size - 1]
                    )
                    size -= 1 - more
            if size > 0:
                decoded, left = 1, 1  # bits of equal probability: all but two, and the sign
                if size > 1:
                    left = size - 1
                    low, scope, at, decoded = _bit(
                        low,
                        scope,
                        at,
                        data,
                        reading,
                        value >> (size - 2) & 1,
                        estimates[group, _CONTEXTS, size],
                    )
                    decoded += 2
                flat = (value << 1 | (difference < 0)) & ((1 << left) - 1)
                while left > 0:
                    some = min(left, _FLAT_BITS)
                    left -= some
                    scope >>= some
                    part = flat >> left & ((1 << some) - 1)
                    if reading:
                        part = min(low // scope, (1 << some) - 1)
                    low += -part * scope if reading else part * scope
                    low, scope, at = _renormalise(low, scope, at, data, reading)
                    decoded = decoded << some | part
                difference = -(decoded >> 1) if decoded & 1 else decoded >> 1
            else:
                difference = 0
            before[column] = predicted + difference
            table[row, column] = before[column]
            sizes[column] += (4 * size - sizes[column] + 1) >> 1
            recent += (8 * size - recent + 2) >> 2
    for _ in range(4 * (not reading)):
        low, _, at = _renormalise(low, np.int64(1 << 16), at, data, reading)
    return at
