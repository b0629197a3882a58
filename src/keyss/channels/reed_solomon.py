"""Reed-Solomon over GF(256) for erasures: any k of n chunks give the data back.

A systematic code of length n <= 255 with the generator polynomial (x - 1)(x - a)...(x - a^(n-k-1)), a = 2,
over the field of the polynomial x^8 + x^4 + x^3 + x^2 + 1: the same codewords, byte for byte, as `reedsolo`
makes. That library codes one codeword of bytes at a time and takes minutes for the payload of a model; here
a chunk is a row of an array, and all its bytes are coded at once. Every chunk carries its number, so that the
lost rows are known. Where tags are so short that some chunks are there by chance, they are found by trying:
the codeword through k chunks that are right agrees with all others that are, every other one with hardly any.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import chain

import numpy as np

from keyss.core.arrays import Bytes, Integers
from keyss.core.errors import InputError

MAX_CHUNKS = 255  # of one codeword
_TRIES = 2000  # of k chunks, in all codewords together
LOST = "the key is right, but too much of the model was lost or changed since the secret was hidden in it"
_POLYNOMIAL = 0x11D


@dataclass(frozen=True)
class Codewords:
    """Data in `count` codewords of `n` chunks of `width` bytes, any `k` of which give a codeword back.

    Chunk i of codeword c has the number i * count + c. Raises ValueError for impossible numbers.
    """

    count: int
    n: int
    k: int
    width: int

    def __post_init__(self) -> None:
        if not (self.count >= 1 and 1 <= self.k <= self.n <= MAX_CHUNKS):
            raise ValueError(f"impossible codewords: {self}")

    @property
    def chunks(self) -> int:
        return self.count * self.n

    @property
    def size(self) -> int:
        """Bytes of data."""
        return self.count * self.k * self.width

    def encode(self, data: bytes) -> Bytes:
        """[chunks, width] of at most `size` bytes, in the order of their numbers."""
        rows = np.frombuffer(data.ljust(self.size, b"\0"), np.uint8).reshape(self.k, -1)
        return encode(rows, self.n).reshape(-1, self.width)

    def decode(self, numbers: Integers, chunks: Bytes, *, errors: bool = False) -> bytes:
        """The data from chunks [C, width] with `numbers` [C], in any order.

        Different chunks with one number are left out: one of them is there by chance. `errors`: so may be
        others. Raises InputError if too few are left.
        """
        inside = numbers < self.chunks
        own, first, of_own = np.unique(numbers[inside], return_index=True, return_inverse=True)
        chunks, left = chunks[inside], len(own)
        data = None
        if left >= self.count * self.k:  # else there is no need for as much memory
            chosen = chunks[first]
            sure = np.ones(left, bool)
            sure[of_own[(chunks != chosen[of_own]).any(axis=1)]] = False
            data = self._decoded(own[sure], chosen[sure], errors)
        if data is None:
            raise InputError(f"{LOST}: {left:,} of {self.chunks:,} chunks are left")
        return data.tobytes()

    def _decoded(self, numbers: Integers, chunks: Bytes, errors: bool) -> Bytes | None:
        data = np.empty((self.k, self.count, self.width), np.uint8)
        rows, codewords = np.divmod(numbers, self.count)
        random, tries = np.random.default_rng(0), iter(range(_TRIES))
        for codeword in range(self.count):
            own = some = np.flatnonzero(codewords == codeword)
            for _ in chain((0,), tries):
                decoded = decode(dict(zip(rows[some].tolist(), chunks[some], strict=True)), self.k, self.n)
                if decoded is None:
                    return None
                data[:, codeword] = decoded
                wrong = 0 if not errors else (encode(decoded, self.n)[rows[own]] != chunks[own]).any(1).sum()
                if 2 * wrong <= len(own) - self.k:  # no other codeword agrees with as many
                    break
                some = random.choice(own, self.k, replace=False)
        return data


def _tables() -> tuple[Bytes, list[int], list[int]]:
    """[256, 256] products; exponentials of 2; logarithms."""
    powers, logarithms = [0] * 510, [0] * 256
    value = 1
    for exponent in range(255):
        powers[exponent] = powers[exponent + 255] = value
        logarithms[value] = exponent
        value = value << 1 ^ (_POLYNOMIAL if value & 128 else 0)
    product = np.zeros((256, 256), np.uint8)
    for a in range(1, 256):
        product[a, 1:] = [powers[logarithms[a] + logarithms[b]] for b in range(1, 256)]
    return product, powers, logarithms


_PRODUCT, _POWERS, _LOGARITHMS = _tables()


def encode(data: Bytes, n: int) -> Bytes:
    """[n, width] of data [k, width]: the k rows, then n - k rows of parity. 1 <= k <= n <= 255."""
    k = len(data)
    if not 1 <= k <= n <= MAX_CHUNKS:
        raise ValueError(f"expected 1 <= k <= n <= {MAX_CHUNKS}, got k = {k}, n = {n}")
    return np.concatenate([data, _times(_parity_matrix(k, n), data)])


def decode(rows: dict[int, Bytes], k: int, n: int) -> Bytes | None:
    """The data [k, width] from any k rows of a codeword of n, by their number; None if there are fewer."""
    if len(rows) < k:
        return None
    width = len(next(iter(rows.values())))
    data = np.zeros((k, width), np.uint8)
    known = [index for index in range(k) if index in rows]
    lost = [index for index in range(k) if index not in rows]
    for index in known:
        data[index] = rows[index]
    if not lost:
        return data
    parity = [index for index in sorted(rows) if index >= k][: len(lost)]
    matrix = _parity_matrix(k, n)[[index - k for index in parity]]
    right = np.stack([rows[index] for index in parity]) ^ _times(matrix[:, known], data[known])
    data[lost] = _solve(matrix[:, lost], right)
    return data


@lru_cache(maxsize=8)
def _parity_matrix(k: int, n: int) -> Bytes:
    """[n - k, k] so that parity = matrix x data: column i is x^(n-1-i) modulo the generator polynomial."""
    size = n - k
    generator = np.zeros(size + 1, np.uint8)  # of the highest power first
    generator[0] = 1
    for exponent in range(size):
        generator[1:] ^= _PRODUCT[_POWERS[exponent]][generator[:-1]]
    matrix = np.zeros((size, k), np.uint8)
    if size == 0:
        return matrix
    remainder = generator[1:].copy()  # x^size modulo the generator
    for column in range(k - 1, -1, -1):
        matrix[:, column] = remainder
        lead = remainder[0]
        remainder = np.append(remainder[1:], np.uint8(0)) ^ _PRODUCT[lead][generator[1:]]
    return matrix


def _times(matrix: Bytes, rows: Bytes) -> Bytes:
    """The matrix product [a, b] x [b, width] over the field."""
    result = np.zeros((len(matrix), rows.shape[1]), np.uint8)
    for index in range(matrix.shape[1]):
        result ^= _PRODUCT[matrix[:, index, None], rows[index]]
    return result


def _solve(matrix: Bytes, right: Bytes) -> Bytes:
    """x of matrix x = right for an invertible square matrix: Gauss-Jordan elimination."""
    size = len(matrix)
    work = np.concatenate([matrix, right], axis=1)
    for column in range(size):
        pivot = column + int(np.flatnonzero(work[column:, column])[0])
        work[[column, pivot]] = work[[pivot, column]]
        inverse = _POWERS[255 - _LOGARITHMS[work[column, column]]]
        work[column] = _PRODUCT[inverse][work[column]]
        factors = work[:, column].copy()
        factors[column] = 0
        work ^= _PRODUCT[factors[:, None], work[column]]
    return work[:, size:]
