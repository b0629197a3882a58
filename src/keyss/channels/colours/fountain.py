"""A rateless code, read softly: any of its bits, in any order, some of them wrong, give the data back.

A Raptor code (Shokrollahi 2006) for noisy channels (Etesami and Shokrollahi 2006). The data bits and parity
bits, sums of many data bits each, are the *intermediate* bits; every *code bit* is the sum of a few of them.
A 64-bit seed that writer and reader know tells which ones, so that no code bit needs a number or a place.
Decoding is belief propagation.

Reed-Solomon needs a place for every symbol, which a hash fills with no Gaussian or with several: it holds a
fifth to a half as much at equal losses (`benchmarks/colours_code.py`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from keyss.channels.mixing import mix
from keyss.core.arrays import Bits, Doubles, Integers, Words

# Of 128 code bits, how many are sums of 1, 2, ... intermediate bits: Shokrollahi 2006, table I, k = 65,536.
_RAPTOR = ((1, 3), (2, 62), (3, 21), (4, 9), (5, 10), (8, 7), (9, 5), (19, 7), (65, 4))
# The same for a few hundred data bits if most code bits are lost or wrong; found by experiment.
NOISY = ((1, 19), (2, 64), (3, 32), (4, 13))
_REPEATS = 4  # parity bits that each data bit takes part in
_ROUNDS, _SETTLED = 60, 3
_SURE, _LEAST = np.float32(1 - 1e-6), np.float32(1e-12)  # limits of |P(0) - P(1)|
_RANK = np.uint64(0xD1B54A32D192ED03)


@dataclass(frozen=True)
class Fountain:
    """The code for `size` data bits."""

    size: int
    degrees: tuple[tuple[int, int], ...] = _RAPTOR

    @property
    def parity(self) -> int:
        """Parity bits: half as many for a few hundred data bits, 4 % and some for many."""
        return 64 + self.size // 25

    def encode(self, data: Bits, seeds: Words) -> Bits:
        """[n] the code bits of `seeds` [n] for `data` [size], zeros and ones."""
        if data.shape != (self.size,):
            raise ValueError(f"expected {self.size} bits, got {data.shape}")
        every = np.concatenate([data, np.bitwise_xor.reduce(data[self._checks()], axis=1)])
        members, starts, _ = self._equations(seeds)
        return np.bitwise_xor.reduceat(every[members], starts)

    def decode(self, seeds: Words, hints: Doubles) -> Bits:
        """The likeliest data [size]; `hints` [n]: P(0) - P(1) of the code bits of `seeds` [n].

        Takes at most 60 rounds, each of about 60 ns for each member of an equation.
        """
        checks = np.column_stack([self._checks(), self.size + np.arange(self.parity)])
        members, starts, rows = self._equations(seeds)
        starts = np.concatenate([starts, len(members) + np.arange(self.parity) * checks.shape[1]])
        rows = np.concatenate([rows, np.repeat(len(seeds) + np.arange(self.parity), checks.shape[1])])
        members = np.concatenate([members, checks.ravel()])
        known = np.concatenate([hints, np.ones(self.parity)]).astype(np.float32).clip(-_SURE, _SURE)
        size = np.log(np.abs(known) + _LEAST)
        total, sent = np.zeros(self.size + self.parity, np.float32), np.zeros(len(members), np.float32)
        settled = 0
        for _ in range(_ROUNDS):
            before = total < 0
            belief = np.tanh((total[members] - sent) / 2)
            sizes, negative = np.log(np.abs(belief) + _LEAST), belief < 0
            product = np.exp((np.add.reduceat(sizes, starts) + size)[rows] - sizes).clip(0, _SURE)
            odd = (np.logical_xor.reduceat(negative, starts) ^ (known < 0))[rows] ^ negative
            sent = 2 * np.arctanh(np.where(odd, -product, product))
            total = np.bincount(members, sent, len(total)).astype(np.float32)
            settled = settled + 1 if np.array_equal(before, total < 0) else 0
            if settled == _SETTLED:
                break
        return (total[: self.size] < 0).astype(np.uint8)

    def _equations(self, seeds: Words) -> tuple[Integers, Integers, Integers]:
        """[m] members of all code bits, [n] where each code bit's begin, [m] which code bit's each is."""
        length = self.size + self.parity
        every = np.repeat(*np.transpose(self.degrees)).clip(1, length // 4)
        degrees = every[(mix(seeds) >> np.uint64(57)).astype(np.int64)]
        return _draw(seeds, degrees, length), np.cumsum(degrees) - degrees, _rows(degrees)

    def _checks(self) -> Integers:
        """[parity, k] the data bits that each parity bit is the sum of: every one in _REPEATS of them."""
        order = np.argsort(mix(np.arange(_REPEATS * self.size, dtype=np.uint64)), kind="stable") // _REPEATS
        return np.resize(order, (self.parity, -(-len(order) // self.parity)))


def _draw(seeds: Words, degrees: Integers, length: int) -> Integers:
    """[m] for each of the seeds [n] as many numbers below `length` as its degree.

    A number that is drawn twice cancels itself, in writing as in reading.
    """
    rows = _rows(degrees)
    rank = np.arange(1, len(rows) + 1) - (np.cumsum(degrees) - degrees)[rows]
    drawn = mix(seeds[rows] ^ rank.astype(np.uint64) * _RANK) >> np.uint64(32)
    return (drawn * np.uint64(length) >> np.uint64(32)).astype(np.int64)


def _rows(degrees: Integers) -> Integers:
    return np.repeat(np.arange(len(degrees)), degrees)
