"""A rateless code with soft decoding: enough code bits in any order recover the data, even if some are wrong.

A Raptor code (Shokrollahi 2006) for noisy channels (Etesami and Shokrollahi 2006). The *intermediate* bits
are the data bits and parity bits, which are sums of many data bits. Every *code bit* is the sum of a few
intermediate bits, chosen by a 64-bit seed that writer and reader know, so code bits need no index. The
decoder is belief propagation.

Reed-Solomon needs a position for every symbol. A hash of IDs fills many positions with no Gaussian or with
several, which are erasures before anything is lost.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from keyss.channels.mixing import mix
from keyss.core.arrays import Bits, Doubles, Integers, Words

# Degree distribution as (degree, count per 128 code bits): Shokrollahi 2006, table I, k = 65,536.
_RAPTOR = ((1, 3), (2, 62), (3, 21), (4, 9), (5, 10), (8, 7), (9, 5), (19, 7), (65, 4))
# The same for a few hundred data bits if most code bits are lost or wrong; found by experiment.
NOISY = ((1, 19), (2, 64), (3, 32), (4, 13))
_REPEATS = 4  # parity bits per data bit
_ROUNDS, _SETTLED = 60, 3  # maximum; rounds without a change before decoding stops
_MAX, _MIN = np.float32(1 - 1e-6), np.float32(1e-12)  # limits of |P(0) - P(1)|
_RANK = np.uint64(0xD1B54A32D192ED03)


@dataclass(frozen=True)
class Fountain:
    """The code for `size` data bits."""

    size: int
    degrees: tuple[tuple[int, int], ...] = _RAPTOR

    @property
    def parity(self) -> int:
        """The number of parity bits: about half as many as a few hundred data bits, 4 % of many."""
        return 64 + self.size // 25

    def encode(self, data: Bits, seeds: Words) -> Bits:
        """Code bits [n] of `seeds` [n] for the bits `data` [size]."""
        every = np.concatenate([data, np.bitwise_xor.reduce(data[self._checks()], axis=1)])
        members, starts, _ = self._equations(seeds)
        return np.bitwise_xor.reduceat(every[members], starts)

    def decode(self, seeds: Words, hints: Doubles) -> Bits:
        """The likeliest data bits [size]; `hints` [n]: P(0) - P(1) of the code bits of `seeds` [n].

        Takes at most 60 rounds of about 60 ns per member of an equation.
        """
        checks = np.column_stack([self._checks(), self.size + np.arange(self.parity)])
        members, starts, rows = self._equations(seeds)
        starts = np.concatenate([starts, len(members) + np.arange(self.parity) * checks.shape[1]])
        rows = np.concatenate([rows, np.repeat(len(seeds) + np.arange(self.parity), checks.shape[1])])
        members = np.concatenate([members, checks.ravel()])
        known = np.concatenate([hints, np.ones(self.parity)]).astype(np.float32).clip(-_MAX, _MAX)
        size = np.log(np.abs(known) + _MIN)
        total, sent = np.zeros(self.size + self.parity, np.float32), np.zeros(len(members), np.float32)
        settled = 0
        for _ in range(_ROUNDS):
            before = total < 0
            belief = np.tanh((total[members] - sent) / 2)
            sizes, negative = np.log(np.abs(belief) + _MIN), belief < 0
            product = np.exp((np.add.reduceat(sizes, starts) + size)[rows] - sizes).clip(0, _MAX)
            odd = (np.logical_xor.reduceat(negative, starts) ^ (known < 0))[rows] ^ negative
            sent = 2 * np.arctanh(np.where(odd, -product, product))
            total = np.bincount(members, sent, len(total)).astype(np.float32)
            settled = settled + 1 if np.array_equal(before, total < 0) else 0
            if settled == _SETTLED:
                break
        return (total[: self.size] < 0).astype(np.uint8)

    def _equations(self, seeds: Words) -> tuple[Integers, Integers, Integers]:
        """Members [m] of all code bits; start [n] of each code bit's members; code bit [m] of each member.

        A member drawn twice cancels itself, in encoding and decoding alike.
        """
        length = self.size + self.parity
        every = np.repeat(*np.transpose(self.degrees)).clip(1, length // 4)
        degrees = every[(mix(seeds) >> np.uint64(57)).astype(np.int64)]
        starts, rows = np.cumsum(degrees) - degrees, np.repeat(np.arange(len(degrees)), degrees)
        rank = np.arange(1, len(rows) + 1) - starts[rows]
        drawn = mix(seeds[rows] ^ rank.astype(np.uint64) * _RANK) >> np.uint64(32)
        return (drawn * np.uint64(length) >> np.uint64(32)).astype(np.int64), starts, rows

    def _checks(self) -> Integers:
        """Data bits [parity, k] of each parity bit; each data bit is in _REPEATS of them."""
        order = np.argsort(mix(np.arange(_REPEATS * self.size, dtype=np.uint64)), kind="stable") // _REPEATS
        return np.resize(order, (self.parity, -(-len(order) // self.parity)))
