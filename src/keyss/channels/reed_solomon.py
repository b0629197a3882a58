"""Reed-Solomon over GF(2^16): any k of n chunks recover the data (Reed and Solomon 1960).

A chunk is a row of 16-bit symbols, big-endian. A column holds the values of a polynomial of degree below k,
chunk i that at the field element i + 1. The first k chunks are the data; Lagrange interpolation gives the
others. The field polynomial is x^16 + x^12 + x^3 + x + 1. Libraries code one column at a time, symbol by
symbol, and take minutes for the payload of a model.

Every chunk has its number, so lost chunks are erasures. Correcting a false chunk, an error, takes two chunks
more than k.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import zip_longest
from typing import Any

import numpy as np

from keyss.core.arrays import Bytes, Flags, Integers, Shorts
from keyss.core.errors import InputError
from keyss.kernels.jit import kernel
from keyss.kernels.parallel import in_blocks

MAX_CHUNKS = 1 << 13  # per codeword; the field would allow more, at a cost in time
SYMBOL_BYTES = 2
LOST = "the key is right, but too much of the model was lost or changed since the secret was hidden in it"
_POLYNOMIAL = 0x1100B
_ORDER = (1 << 16) - 1  # of the generator 2
_ZERO = 4 * _ORDER  # logarithm of 0: sums with other logarithms are exponents of 0
_AT_ONCE = 1 << 18  # factors per step, which bounds memory
_COLUMNS = 128  # per block, which fits into the cache
_MAX_ERRORS = 128  # maximum number of errors to locate per codeword


@dataclass(frozen=True)
class Codewords:
    """Data in `count` codewords of `n` chunks of `width` bytes; any `k` chunks recover a codeword.

    Chunk i of codeword c has the number i * count + c. Raises ValueError for impossible values.
    """

    count: int
    n: int
    k: int
    width: int

    def __post_init__(self) -> None:
        if not (self.count >= 1 and 1 <= self.k <= self.n <= MAX_CHUNKS and self.width % SYMBOL_BYTES == 0):
            raise ValueError(f"impossible codewords: {self}")

    @property
    def chunks(self) -> int:
        return self.count * self.n

    @property
    def size(self) -> int:
        """Bytes of data."""
        return self.count * self.k * self.width

    def encode(self, data: bytes) -> Bytes:
        """Encode at most `size` bytes as chunks [chunks, width] in the order of their numbers."""
        rows = np.frombuffer(data.ljust(self.size, b"\0"), np.uint8).reshape(self.k, -1)
        parity = _interpolate(np.arange(self.k), rows, np.arange(self.k, self.n), self.k)
        return np.concatenate([rows, parity]).reshape(-1, self.width)

    def decode(self, numbers: Integers, chunks: Bytes, *, errors: bool = False) -> bytes:
        """Decode chunks [C, width] with `numbers` [C], in any order.

        Ignores numbers with contradictory chunks. `errors`: other chunks may be false too. Raises InputError
        if too few are left.
        """
        inside = numbers < self.chunks
        unique, first, inverse = np.unique(numbers[inside], return_index=True, return_inverse=True)
        chunks, left = chunks[inside], len(unique)
        if left >= self.count * self.k:  # otherwise save the memory
            chosen = chunks[first]
            sure = np.ones(left, bool)
            sure[inverse[(chunks != chosen[inverse]).any(axis=1)]] = False
            rows, codewords = np.divmod(unique[sure], self.count)
            data, chosen = np.empty((self.k, self.count, self.width), np.uint8), chosen[sure]
            order = np.argsort(codewords, kind="stable")
            own = np.split(order, np.searchsorted(codewords[order], np.arange(1, self.count)))
            if all(self._decode(rows[o], chosen[o], data[:, at], errors) for at, o in enumerate(own)):
                return data.tobytes()
        raise InputError(f"{LOST}: {left:,} of {self.chunks:,} chunks are left")

    def _decode(self, numbers: Integers, rows: Bytes, data: Bytes, errors: bool) -> bool:
        """Decode the codeword of rows [C, width] with `numbers` [C] into `data` [k, width].

        False if too few are left.
        """
        if errors and len(rows) > self.k:
            consistent = _consistent_rows(numbers, rows, self.k, self.n)
            numbers, rows = numbers[consistent], rows[consistent]
        if len(rows) < self.k:
            return False
        order = np.argsort(numbers)[: self.k]  # data first
        numbers, rows = numbers[order], rows[order]
        known = numbers < self.k
        data[numbers[known]] = rows[known]
        lost = np.setdiff1d(np.arange(self.k), numbers)
        data[lost] = _interpolate(numbers, rows, lost, self.n)
        return True


def _tables() -> tuple[Shorts, Integers]:
    """Powers of 2, zeros from `_ZERO` - `_ORDER` on; and logarithms [2^16]."""
    powers = np.zeros(2 * _ZERO + 1, np.uint16)
    logarithms = np.full(1 << 16, _ZERO)
    value = 1
    for exponent in range(_ORDER):
        powers[exponent : _ZERO - _ORDER : _ORDER] = value
        logarithms[value] = exponent
        value = value << 1 ^ (_POLYNOMIAL if value >> 15 else 0)
    return powers, logarithms


_POWERS, _LOGARITHMS = _tables()


def _interpolate(numbers: Integers, rows: Bytes, wanted: Integers, n: int) -> Bytes:
    """Interpolate rows [W, width] with numbers `wanted` [W] from k rows [k, width] with `numbers` below `n`.

    The value at x is the sum of P(x) v / ((x - a) P'(a)) over all points a with values v. P(x) is the product
    of x - a over all points, P'(a) the product of a - b over all other points b.
    """
    found = np.zeros((len(wanted), rows.shape[1] // SYMBOL_BYTES), np.uint16)
    if len(wanted):
        points, at = numbers + 1, wanted + 1
        values = _scale(rows, -_own_products(numbers, n))
        outside = _products(at, points)
        step = max(1, _AT_ONCE // len(points))
        for low in range(0, len(at), step):
            some = slice(low, low + step)
            factors = outside[some, None] + _ORDER - _LOGARITHMS[at[some, None] ^ points]

            def add(start: int, stop: int, own: Shorts = found[some], factors: Integers = factors) -> None:
                part = np.ascontiguousarray(values[:, start:stop], np.int32)
                _add_products(factors, part, _POWERS, own[:, start:stop])

            in_blocks(add, values.shape[1], _COLUMNS)
    return found.astype(">u2").view(np.uint8)


@kernel
def _add_products(factors: Any, values: Any, powers: Any, found: Any) -> None:
    """Add the products of `factors` [W, k] and `values` [k, S], given as logarithms, to `found` [W, S]."""
    for row in range(len(found)):
        for point in range(len(values)):
            factor = factors[row, point]
            for column in range(values.shape[1]):
                found[row, column] ^= powers[factor + values[point, column]]


def _scale(rows: Bytes, logarithms: Integers) -> Integers:
    """Logarithms [C, width / 2] of the symbols of rows [C, width] times factors with `logarithms` [C]."""
    symbols = _LOGARITHMS[np.ascontiguousarray(rows).view(">u2")]
    return np.where(symbols == _ZERO, _ZERO, (symbols + logarithms[:, None]) % _ORDER)


def _own_products(numbers: Integers, n: int) -> Integers:
    """`_products` [C] of the points of `numbers` [C] among themselves, from the few missing ones below n."""
    missing = np.setdiff1d(np.arange(n), numbers)
    return (_all_products(n)[numbers] - _products(numbers + 1, missing + 1)) % _ORDER


@lru_cache(maxsize=4)
def _all_products(n: int) -> Integers:
    """`_products` [n] of the first n points among themselves."""
    points = np.arange(1, n + 1)
    return _products(points, points)


def _products(at: Integers, points: Integers) -> Integers:
    """Logarithms [A] of the products of differences between each of `at` [A] and all other `points` [P]."""
    logarithms = _LOGARITHMS.copy()
    logarithms[0] = 0
    step = max(1, _AT_ONCE // max(1, len(points)))
    parts = [logarithms[at[low : low + step, None] ^ points].sum(axis=1) for low in range(0, len(at), step)]
    return np.concatenate(parts) % _ORDER


def _consistent_rows(numbers: Integers, rows: Bytes, k: int, n: int) -> Flags:
    """Mask [C] of the rows [C, width] that belong to the codeword of the majority; C is more than k.

    For a codeword, the syndromes, the sums of v a^t / P'(a) over all rows (see `_interpolate`), vanish for
    t < C - k. Otherwise their shortest linear recurrence locates the errors (Massey 1969); if there are too
    many, it finds none.
    """
    points = numbers + 1
    values = _scale(rows, -_own_products(numbers, n))
    combined = np.bitwise_xor.reduce(_POWERS[values + np.arange(values.shape[1])], axis=1)  # over columns
    terms, powers = _LOGARITHMS[combined], _LOGARITHMS[points]
    times = np.arange(min(len(rows) - k, 2 * _MAX_ERRORS))[:, None]
    syndromes = np.bitwise_xor.reduce(_POWERS[terms + times * powers % _ORDER], axis=1)
    locator = _recurrence(syndromes.tolist()) if syndromes.any() else [1]
    located = np.zeros(len(rows), np.uint16)  # the locator at 1 / a
    for power, coefficient in enumerate(locator):
        located ^= _POWERS[_LOGARITHMS[coefficient] + -power * powers % _ORDER]
    consistent: Flags = located != 0
    return consistent


def _recurrence(sums: list[int]) -> list[int]:
    """Coefficients, 1 first, of the shortest linear recurrence of a sequence (Berlekamp-Massey)."""
    found, before, length, since, scale = [1], [1], 0, 1, 1
    for index in range(len(sums)):
        discrepancy = 0
        for each, coefficient in enumerate(found[: length + 1]):
            discrepancy ^= _product(coefficient, sums[index - each])
        if discrepancy == 0:
            since += 1
            continue
        factor = _product(discrepancy, int(_POWERS[_ORDER - _LOGARITHMS[scale]]))
        shifted = [0] * since + [_product(factor, each) for each in before]
        kept, found = found, [a ^ b for a, b in zip_longest(found, shifted, fillvalue=0)]
        if 2 * length <= index:
            length, before, scale, since = index + 1 - length, kept, discrepancy, 1
        else:
            since += 1
    return found


def _product(a: int, b: int) -> int:
    return int(_POWERS[_LOGARITHMS[a] + _LOGARITHMS[b]])
