"""Reed-Solomon over GF(2^16): any k of n shards recover the data (Reed and Solomon 1960).

A shard is a row of 16-bit symbols, big-endian. A column holds the values of a polynomial f of degree below k,
shard i that at the point `_POINTS`[i]. The first k shards are the data. The field polynomial is
x^16 + x^12 + x^3 + x + 1. Points are sums of a Cantor basis b: b_0 = 1, and b_j^2 + b_j = b_(j-1).

All codewords are restored together, however their losses differ, in O(log n) operations per symbol, by the
additive FFT of Lin, Chung and Han (2014) and Forney's algorithm. Let L be the polynomial that vanishes at the
lost points. The product f L is known everywhere: it is zero where f is not known. At a lost point, its
derivative is f L'. An inverse FFT interpolates the product, and an FFT evaluates its derivative.

Every shard has its number, so lost shards are erasures. Correcting a false shard, an error, takes two shards
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
from keyss.kernels.jit import inline, kernel
from keyss.kernels.parallel import in_blocks

MAX_SHARDS = 1 << 13  # per codeword; the field would allow more, at a cost in time
SYMBOL_BYTES = 2
LOST = (
    "the key is right, but too much of the model was lost or changed since the secret was hidden in it: use "
    "the file as it was published"
)
_POLYNOMIAL = 0x1100B
_ORDER = (1 << 16) - 1  # order of the generator 2
_ZERO = 2 * _ORDER  # logarithm of 0: sums with other logarithms are exponents of 0
_COLUMNS = 128  # per block, which fits into the cache
_MAX_ERRORS = 128  # maximum number of errors to locate per codeword


@dataclass(frozen=True)
class Codewords:
    """Data in `count` codewords of `n` shards of `width` bytes; any `k` shards recover a codeword.

    Shard i of codeword c has the number i * count + c. Raises ValueError for impossible values.
    """

    count: int
    n: int
    k: int
    width: int

    def __post_init__(self) -> None:
        if not (self.count >= 1 and 1 <= self.k <= self.n <= MAX_SHARDS and self.width % SYMBOL_BYTES == 0):
            raise ValueError(f"impossible codewords: {self}")

    @property
    def shards(self) -> int:
        return self.count * self.n

    @property
    def size(self) -> int:
        """Bytes of data."""
        return self.count * self.k * self.width

    def encode(self, data: bytes) -> Bytes:
        """Encode at most `size` bytes as shards [shards, width] in the order of their numbers."""
        shards = np.zeros((self.shards, self.width), np.uint8)
        shards.reshape(-1)[: len(data)] = np.frombuffer(data, np.uint8)
        rows = np.arange(self.shards).reshape(self.n, self.count)
        rows[self.k :] = -1
        _restore(shards, rows, shards.reshape(self.n, self.count, self.width))
        return shards

    def decode(self, numbers: Integers, shards: Bytes, *, errors: bool = False) -> memoryview:
        """Decode shards [C, width] with `numbers` [C], in any order.

        Ignores numbers with contradictory shards. `errors`: other shards may be false too. Raises InputError
        if too few are left.
        """
        inside = np.flatnonzero(numbers < self.shards)
        places = numbers[inside]
        if len(places) >= self.count * self.k:  # too few shards cannot be decoded
            first = np.full(self.shards, -1)
            first[places[::-1]] = inside[::-1]
            again = inside[first[places] != inside]
            differ = (shards[again] != shards[first[numbers[again]]]).any(axis=1)
            first[numbers[again[differ]]] = -1
            rows: Integers = first.reshape(self.n, self.count)
            if errors:
                self._drop_errors(rows, shards)
            if ((rows >= 0).sum(axis=0) >= self.k).all():
                data: Bytes = shards.take(rows[: self.k], axis=0)
                _restore(shards, rows, data)
                return data.reshape(-1).data
        left, needed = len(np.unique(places)), self.count * self.k
        raise InputError(f"{LOST} ({left:,} of {self.shards:,} shards are left, at least {needed:,} needed)")

    def _drop_errors(self, rows: Integers, shards: Bytes) -> None:
        """Set the `rows` [n, count] of false shards to -1."""
        for column in rows.T:
            numbers = np.flatnonzero(column >= 0)
            if len(numbers) > self.k:
                column[numbers[~_consistent_rows(numbers, shards[column[numbers]], self.k, self.n)]] = -1


def _tables() -> tuple[Shorts, Integers]:
    """Powers of 2, of exponents below `_ZERO` twice all, and then zeros; and logarithms [2^16]."""
    value, values = 1, []
    for _ in range(_ORDER):
        values.append(value)
        value = value << 1 ^ (_POLYNOMIAL if value >> 15 else 0)
    powers = np.zeros(2 * _ZERO + 1, np.uint16)
    powers[:_ZERO] = values * 2
    logarithms = np.full(1 << 16, _ZERO)
    logarithms[values] = np.arange(_ORDER)
    return powers, logarithms


_POWERS, _LOGARITHMS = _tables()


def _points() -> Integers:
    """[2 MAX_SHARDS] field elements: sums of a Cantor basis, at index i of those whose bits are set in i."""
    every = np.arange(1 << 16)
    squares = _POWERS[_LOGARITHMS * 2 % _ORDER] * (every > 0)
    points, basis = np.zeros(1, np.int64), 1
    while len(points) < 2 * MAX_SHARDS:
        points = np.concatenate([points, points ^ basis])
        basis = int(np.flatnonzero((squares ^ every) == basis)[0])  # the smaller of two roots
    return points


_POINTS = _points()


def _restore(shards: Bytes, rows: Integers, data: Bytes) -> None:
    """Fill the rows of `data` [R, count, width] whose shard is lost.

    `rows` [n, count]: the row of `shards` of each shard; -1 for lost ones.
    """
    columns = shards.shape[1] // SYMBOL_BYTES
    wanted = np.flatnonzero((rows[: len(data)] < 0).any(axis=0))
    values, logarithms, twiddles, walsh = rows[:, wanted], _LOGARITHMS, *_constants(_size(len(rows)))

    def restore(start: int, stop: int) -> None:
        _restore_columns(start, stop, shards, values, wanted, data, _POWERS, logarithms, twiddles, walsh)

    in_blocks(restore, len(wanted) * columns, _COLUMNS, _restore_columns)


def _size(n: int) -> int:
    """The size of FFTs for `n` points."""
    return 1 << (n - 1).bit_length()


@lru_cache(maxsize=4)
def _constants(size: int) -> tuple[Shorts, Integers]:
    """Products of twiddle factors and the lower and upper bytes of symbols [size / 2, 2, 256], for FFTs of
    `size`; the Walsh-Hadamard transform of the points' logarithms.
    """
    twiddles = _LOGARITHMS[_POINTS[:size:2]]
    bytes_ = _LOGARITHMS[np.arange(256) << np.array([[0], [8]])]
    walsh = _LOGARITHMS[_POINTS[:size]]
    walsh[0] = 0
    _walsh(walsh)
    return _POWERS[twiddles[:, None, None] + bytes_], walsh


@kernel
def _walsh(values: Any) -> None:
    """Walsh-Hadamard transform in place, which turns convolutions over xor into products."""
    half = 1
    while half < len(values):
        for start in range(0, len(values), 2 * half):
            for at in range(start, start + half):
                values[at], values[at + half] = values[at] + values[at + half], values[at] - values[at + half]
        half *= 2


@kernel
def _multiply_differences(points: Any, walsh: Any) -> None:
    """Replace marks, 1 or 0, by logarithms of products: of the differences to all other marked points."""
    _walsh(points)
    points *= walsh
    _walsh(points)
    for at in range(len(points)):
        points[at] = points[at] // len(points) % 65535


@kernel
def _restore_columns(
    start: Any,
    stop: Any,
    shards: Any,
    rows: Any,
    wanted: Any,
    data: Any,
    powers: Any,
    logarithms: Any,
    twiddles: Any,
    walsh: Any,
) -> None:
    """`_restore` for columns `start` to `stop` of all codewords in a line.

    `rows` [n, C], `wanted` [C]: of codewords with losses.
    """
    size, columns = len(walsh), shards.shape[1] // 2
    first, last = start // columns, (stop - 1) // columns
    products = np.ones((last - first + 1, size), np.int64)  # L' at lost points, else L, as logarithms
    work = np.zeros((size, stop - start), np.uint16)
    for codeword in range(first, last + 1):
        tables = products[codeword - first]
        offset = codeword * columns - start
        for point in range(len(rows)):
            tables[point] = rows[point, codeword] < 0
        _multiply_differences(tables, walsh)
        for point in range(len(rows)):
            row = rows[point, codeword]
            if row >= 0:
                for at in range(max(0, offset), min(stop - start, offset + columns)):
                    symbol = shards[row, 2 * (at - offset)] << 8 | shards[row, 2 * (at - offset) + 1]
                    work[point, at] = powers[tables[point] + logarithms[symbol]]
    _to_coefficients(work, twiddles)
    _differentiate(work)
    _to_values(work, twiddles)
    for codeword in range(first, last + 1):
        tables = products[codeword - first]
        offset = codeword * columns - start
        for point in range(min(len(rows), len(data))):
            if rows[point, codeword] < 0:
                shard = data[point, wanted[codeword]]
                for at in range(max(0, offset), min(stop - start, offset + columns)):
                    symbol = powers[65535 - tables[point] + logarithms[work[point, at]]]
                    shard[2 * (at - offset)], shard[2 * (at - offset) + 1] = symbol >> 8, symbol & 255


@inline
def _add_product(to: Any, values: Any, table: Any) -> None:
    for at in range(len(to)):
        to[at] ^= table[0, values[at] & 255] ^ table[1, values[at] >> 8]


@inline
def _add(to: Any, values: Any) -> None:
    for at in range(len(to)):
        to[at] ^= values[at]


@kernel
def _to_coefficients(work: Any, twiddles: Any) -> None:
    """From values at `_POINTS` to coefficients in the basis of Lin, Chung and Han, in place."""
    half = 1
    while half < len(work):
        for start in range(0, len(work), 2 * half):
            table = twiddles[start // half // 2]
            for row in range(start, start + half):
                _add(work[row + half], work[row])
                if start:  # otherwise the factor is zero
                    _add_product(work[row], work[row + half], table)
        half *= 2


@kernel
def _to_values(work: Any, twiddles: Any) -> None:
    """Invert `_to_coefficients`."""
    half = len(work) // 2
    while half:
        for start in range(0, len(work), 2 * half):
            table = twiddles[start // half // 2]
            for row in range(start, start + half):
                if start:
                    _add_product(work[row], work[row + half], table)
                _add(work[row + half], work[row])
        half //= 2


@kernel
def _differentiate(work: Any) -> None:
    """Replace coefficients by those of the derivative; with Cantor's basis, all factors are one."""
    for row in range(len(work)):
        work[row] = 0
        half = 1
        while half < len(work):
            if not row & half:
                _add(work[row], work[row + half])
            half *= 2


def _scale(rows: Bytes, logarithms: Integers) -> Integers:
    """Logarithms [C, width / 2] of the symbols of rows [C, width] times factors with `logarithms` [C]."""
    symbols = _LOGARITHMS[np.ascontiguousarray(rows).view(">u2")]
    return np.where(symbols == _ZERO, _ZERO, (symbols + logarithms[:, None]) % _ORDER)


def _consistent_rows(numbers: Integers, rows: Bytes, k: int, n: int) -> Flags:
    """Mask [C] of the rows [C, width] that belong to the codeword of the majority; C is more than k.

    For a codeword, the syndromes, the sums of v a^t / P'(a) over all rows, vanish for t < C - k: v are the
    values, a their points, all moved so that none is zero, and P'(a) the product of a - b over all other
    points b. Otherwise their shortest linear recurrence locates the errors (Massey 1969); if there are too
    many, it finds none.
    """
    points = _POINTS[MAX_SHARDS + numbers]
    _, walsh = _constants(_size(n))
    products = np.zeros(len(walsh), np.int64)
    products[numbers] = 1
    _multiply_differences(products, walsh)
    values = _scale(rows, -products[numbers])
    powers, consistent = _LOGARITHMS[points], np.ones(len(rows), bool)
    times = np.arange(min(len(rows) - k, 2 * _MAX_ERRORS))[:, None]
    for step in (1, 2):  # different sums over the columns; both miss an error in one of 2^32 cases
        weights = step * np.arange(values.shape[1]) % _ORDER
        terms = _LOGARITHMS[np.bitwise_xor.reduce(_POWERS[values + weights], axis=1)]
        syndromes = np.bitwise_xor.reduce(_POWERS[terms + times * powers % _ORDER], axis=1)
        locator = _recurrence(syndromes.tolist()) if syndromes.any() else [1]
        located = np.zeros(len(rows), np.uint16)  # the locator at 1 / a
        for power, coefficient in enumerate(locator):
            located ^= _POWERS[_LOGARITHMS[coefficient] + -power * powers % _ORDER]
        consistent &= located != 0
    return consistent


def _recurrence(sums: list[int]) -> list[int]:
    """Coefficients, 1 first, of the shortest linear recurrence of a sequence (Berlekamp-Massey)."""
    locator, before, length, since, scale = [1], [1], 0, 1, 1
    for index in range(len(sums)):
        discrepancy = 0
        for power, coefficient in enumerate(locator[: length + 1]):
            discrepancy ^= _product(coefficient, sums[index - power])
        if discrepancy == 0:
            since += 1
            continue
        factor = _product(discrepancy, int(_POWERS[_ORDER - _LOGARITHMS[scale]]))
        shifted = [0] * since + [_product(factor, value) for value in before]
        kept, locator = locator, [a ^ b for a, b in zip_longest(locator, shifted, fillvalue=0)]
        if 2 * length <= index:
            length, before, scale, since = index + 1 - length, kept, discrepancy, 1
        else:
            since += 1
    return locator


def _product(a: int, b: int) -> int:
    return int(_POWERS[_LOGARITHMS[a] + _LOGARITHMS[b]])
