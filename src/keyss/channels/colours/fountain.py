"""A rateless code, read softly: any bits of it, in any order, some of them wrong, give the data back.

A Raptor code (Shokrollahi 2006) for noisy channels (Etesami and Shokrollahi 2006). The data bits and some
parity bits are the *intermediate* bits; every *code bit* is the sum of a few of them, and which ones follows
from a 64-bit seed that writer and reader both know. So nothing needs a number or a place: a reader uses the
code bits that it has. Parity bits are those of an irregular repeat-accumulate code (Jin, Khandekar and
McEliece 2000). Decoding is belief propagation, one check after the other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from keyss.channels.mixing import mixed
from keyss.core.arrays import Bits, Floats, Integers, Words
from keyss.rendering.cpu.jit import kernel

# Shares of code bits that are sums of 1, 2, ... intermediate bits (Shokrollahi 2006, table I, k = 65,536),
# with more single ones, which belief propagation starts from where code bits are noisy.
_RAPTOR = (
    *((1, 0.020), (2, 0.486), (3, 0.163), (4, 0.072), (5, 0.081), (8, 0.055), (9, 0.037), (19, 0.055)),
    (65, 0.031),
)
# For a few hundred data bits if most code bits are lost or wrong; found by experiment.
NOISY = ((1, 0.15), (2, 0.50), (3, 0.25), (4, 0.10))
_REPEATS = 4  # parity checks that each data bit takes part in
_SURE = 25.0  # log-likelihood ratio of what is known
_MAX = 30.0  # of any message
_SETTLED = 3
_RANK = np.uint64(0xD1B54A32D192ED03)
_BLOCK = 1 << 16  # equations at a time


@dataclass(frozen=True)
class Fountain:
    """The code for `size` data bits."""

    size: int
    degrees: tuple[tuple[int, float], ...] = _RAPTOR  # shares of code bits that are sums of so many

    @property
    def parity(self) -> int:
        """Parity bits: half as many for a few hundred data bits, 4 % and some for many."""
        return 64 + self.size // 25

    @property
    def length(self) -> int:
        """Intermediate bits."""
        return self.size + self.parity

    def encode(self, data: Bits, seeds: Words) -> Bits:
        """[n] the code bits of `seeds` [n] for `data` [size], zeros and ones."""
        if data.shape != (self.size,):
            raise ValueError(f"expected {self.size} bits, got {data.shape}")
        every = np.concatenate([data, np.zeros(self.parity, np.uint8)]).astype(np.uint8)
        checks = _parity_checks(self.size, self.parity)
        previous = 0
        for index in range(self.parity):
            start, end = checks[0][index], checks[0][index + 1]
            others = checks[1][start:end]
            previous = int(every[others[others < self.size]].sum() & 1) ^ previous
            every[self.size + index] = previous
        return self.sums(every, seeds)

    def sums(self, every: Bits, seeds: Words) -> Bits:
        """[n] the code bits of `seeds` [n] for intermediate bits [length]."""
        starts, members = equations(seeds, self.length, self.degrees)
        return (np.add.reduceat(every[members], starts[:-1]) & 1).astype(np.uint8)

    def decode(self, seeds: Words, ratios: Floats, rounds: int) -> tuple[Bits, bool]:
        """The likeliest data [size], and whether all checks hold; see `likeliest`."""
        every, done = self.likeliest(seeds, ratios, rounds)
        return every[: self.size], done

    def likeliest(self, seeds: Words, ratios: Floats, rounds: int) -> tuple[Bits, bool]:
        """The likeliest intermediate bits [length], and whether all checks hold.

        `ratios` [n]: natural logarithms of P(0) / P(1) of the code bits of `seeds` [n]. Takes at most
        `rounds` passes, each of about 40 ns for each member of an equation.
        """
        starts, members = equations(seeds, self.length, self.degrees)
        own_starts, own_members = _parity_checks(self.size, self.parity)
        starts = np.concatenate([starts, starts[-1] + own_starts[1:]])
        members = np.concatenate([members, own_members])
        given = np.concatenate([ratios, np.full(self.parity, _SURE)]).astype(np.float32).clip(-_SURE, _SURE)
        total, done = _propagate(starts, members, given, self.length, self.parity, rounds)
        return (total < 0).astype(np.uint8), bool(done)


def equations(
    seeds: Words, length: int, degrees: tuple[tuple[int, float], ...] = _RAPTOR
) -> tuple[Integers, npt.NDArray[np.int32]]:
    """[n + 1] where each equation starts among the members, and the members, numbers below `length`.

    A member that is drawn twice cancels itself, in writing as in reading.
    """
    shares = np.cumsum([share for _, share in degrees])[:-1]
    most = np.minimum([degree for degree, _ in degrees], max(1, length // 4))
    uniform = mixed(seeds) / 2.0**64
    chosen = most[np.searchsorted(shares, uniform, side="right")]
    starts = np.concatenate([[0], np.cumsum(chosen)]).astype(np.int64)
    members = np.empty(starts[-1], np.int32)
    for first in range(0, len(seeds), _BLOCK):  # what lies between takes ten times the memory of the result
        own = slice(first, first + _BLOCK)
        start = starts[first]
        where = np.repeat(starts[:-1][own] - start, chosen[own])
        rank = (np.arange(len(where)) - where).astype(np.uint64)
        drawn = mixed(np.repeat(seeds[own], chosen[own]) ^ (rank + np.uint64(1)) * _RANK)
        numbers = (drawn >> np.uint64(32)) * np.uint64(length) >> np.uint64(32)
        members[start : start + len(where)] = numbers.astype(np.int32)
    return starts, members


@lru_cache(maxsize=4)
def _parity_checks(size: int, parity: int) -> tuple[Integers, npt.NDArray[np.int32]]:
    """[parity + 1] starts, and members: data bits, the parity bit of the check and the one before it."""
    times = np.arange(size * _REPEATS)
    # Every data bit in _REPEATS checks, all checks nearly equally often.
    order = np.argsort(mixed(times.astype(np.uint64) ^ np.uint64(size << 20)), kind="stable")
    check = np.empty(len(times), np.int64)
    check[order] = np.arange(len(times)) % parity
    rows = [check, np.arange(parity), np.arange(1, parity)]
    columns = [times // _REPEATS, size + np.arange(parity), size + np.arange(parity - 1)]
    row, column = np.concatenate(rows), np.concatenate(columns)
    order = np.lexsort((column, row))
    starts = np.concatenate([[0], np.cumsum(np.bincount(row, minlength=parity))]).astype(np.int64)
    return starts, column[order].astype(np.int32)


@kernel
def _propagate(starts: Any, members: Any, given: Any, length: int, parity: int, rounds: int) -> Any:
    """Totals [length] after belief propagation, and whether the last `parity` of the checks hold."""
    total = np.zeros(length, np.float32)
    sent = np.zeros(len(members), np.float32)
    widest = 1
    for check in range(len(given)):
        widest = max(widest, starts[check + 1] - starts[check])
    before = np.empty(widest + 1, np.float64)
    factor = np.empty(widest, np.float64)
    held = 0  # rounds in a row in which the parity checks hold: they may by chance before all is settled
    for _ in range(rounds):
        for check in range(len(given)):
            first, degree = starts[check], starts[check + 1] - starts[check]
            before[0] = math.tanh(given[check] / 2)
            for i in range(degree):
                factor[i] = math.tanh((total[members[first + i]] - sent[first + i]) / 2)
                before[i + 1] = before[i] * factor[i]
            after = 1.0
            for j in range(degree):
                i = degree - 1 - j
                product = before[i] * after
                after *= factor[i]
                if product > 0.9999999999:
                    message = _MAX
                elif product < -0.9999999999:
                    message = -_MAX
                else:
                    message = math.log((1 + product) / (1 - product))
                member = members[first + i]
                total[member] += np.float32(message) - sent[first + i]
                sent[first + i] = message
        held += 1
        for check in range(len(given) - parity, len(given)):
            odd = 0
            for i in range(starts[check], starts[check + 1]):
                odd ^= total[members[i]] < 0
            if odd:
                held = 0
                break
        if held == _SETTLED:
            break
    return total, held > 0
