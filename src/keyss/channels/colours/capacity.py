"""How much a model holds, and where a payload goes: it should show and cost as little as possible.

The variance that writing adds gives a payload away. It is least for each byte with one bit in
each number (`depth` 1). So a payload gets a share of the carriers at that depth, as large as it needs; one
that needs more gets all carriers, and the least depth and level that hold it.

A payload that is small enough is written only where that leaves the model as likely as it was (`likeness`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from keyss.channels.colours.carriers import CELL, Carriers, Doubles, Numbers
from keyss.channels.colours.header import SHARES, UNNOTICED, Kind, bucket_bytes
from keyss.channels.colours.lattice import COLUMNS, LEVELS, MAX_BITS, SPACING, Lattice
from keyss.channels.colours.likeness import Likeness
from keyss.channels.colours.payload import OVERHEAD
from keyss.channels.colours.quiet import Quiet
from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.rendering.difference import psnr_between

_RATE = 0.42  # data bits for each bit of information that is expected to be read
_GARBAGE = 0.02  # share of carriers whose name has changed although it seemed safe
_COMFORTABLE = 0.8  # of what a share holds: the less, the more may be lost
_ROBUST = 0.5  # the same of a payload that shows anyway
SPREAD = 0.5  # dB by which what is written may cost more than what was measured


@dataclass(frozen=True)
class Layout:
    """Where payloads go: each gets so many SHARES of the carriers."""

    lattice: Lattice
    shares: tuple[int, ...]
    likely: bool = False  # numbers keep their values where others would be less likely


@dataclass(frozen=True)
class Capacity:
    """What a model holds."""

    model: Gaussians
    numbers: Numbers
    measured: dict[Lattice, float] = field(default_factory=dict, compare=False)  # dB

    def bytes(self, strength: float, *, unseen: bool = False) -> int:
        """That one payload may have at most at this cost in dB.

        `unseen`: in one bit of each number, where that leaves a number as likely as it was.
        """
        if not len(self.own):
            return 0
        lattice = self._within(1 if unseen else MAX_BITS, strength)
        return max(0, self._bytes(lattice, likely=unseen) - OVERHEAD)

    def layout(self, sizes: Sequence[int], strength: float) -> Layout | None:
        """For payloads of these sizes in bytes with all that belongs to them; None where they do not fit."""
        quiet = self._within(1, strength)
        for likely in (True, False):
            for comfort in (_COMFORTABLE, 1.0):
                shares = self._shares(sizes, quiet, comfort, likely)
                if sum(shares) <= SHARES:
                    return Layout(quiet, shares, likely)
        for comfort in (_ROBUST, 1.0):
            for depth in range(2, MAX_BITS + 1):
                lattice, shares = self._least(sizes, depth, comfort)
                if sum(shares) <= SHARES and self.costs(lattice) >= strength + SPREAD:
                    return Layout(lattice, _stretched(shares))
        lattice = self._within(MAX_BITS, strength)
        shares = self._shares(sizes, lattice, 1.0)
        return Layout(lattice, _stretched(shares)) if sum(shares) <= SHARES else None

    def _least(self, sizes: Sequence[int], depth: int, comfort: float) -> tuple[Lattice, tuple[int, ...]]:
        """The lowest level of this depth that holds them, or the highest of all."""
        for level in range(LEVELS):
            lattice = Lattice(level, depth)
            shares = self._shares(sizes, lattice, comfort)
            if sum(shares) <= SHARES:
                break
        return lattice, shares

    def costs(self, lattice: Lattice) -> float:
        """PSNR in dB that a payload in all carriers leaves with its headers."""
        if lattice not in self.measured:
            random = np.random.default_rng(0)
            noise = lattice.noise(self.own, random)
            headers = random.random(len(self.own)) < self._headers(lattice.depth)
            noise[headers] = Kind.of(lattice.depth).lattice.noise(self.own[headers], random)
            noise[self.alone[self.own_rows]] = 0
            sh = self.model.sh.detach().clone()
            rows = self.numbers.rows[self.own_rows]
            sh[rows, 0, 1:] += sh.new_tensor(noise)
            self.measured[lattice] = psnr_between(self.model, replace(self.model.detach(), sh=sh))
        return self.measured[lattice]

    def _shares(
        self, sizes: Sequence[int], lattice: Lattice, comfort: float, likely: bool = False
    ) -> tuple[int, ...]:
        room = comfort * self._room(lattice, likely)
        buckets = [bucket_bytes(bucket_of(size)) for size in sizes]
        return tuple(max(1, math.ceil(SHARES * min(1e6, size / max(room, 1e-3)))) for size in buckets)

    def _within(self, depth: int, strength: float) -> Lattice:
        """The highest level of this depth that costs no more than `strength` allows, or the least of all."""
        if not (math.isfinite(strength) and strength > 0):
            raise UsageError(f"expected a `strength` above 0 dB, got {strength}")
        every = [Lattice(level, depth) for level in range(LEVELS)]
        if self.costs(every[-1]) >= strength + SPREAD:
            return every[-1]
        least, beyond = 0, LEVELS - 1
        while beyond - least > 1:
            middle = (least + beyond) // 2
            fits = self.costs(every[middle]) >= strength + SPREAD
            least, beyond = (middle, beyond) if fits else (least, middle)
        return every[least]

    def _bytes(self, lattice: Lattice, likely: bool = False) -> int:
        """Of the largest bucket that fits."""
        room = self._room(lattice, likely)
        return max((bucket_bytes(each) for each in range(256) if bucket_bytes(each) <= room), default=0)

    def _room(self, lattice: Lattice, likely: bool = False) -> float:
        """Bytes that all carriers hold."""
        information = self._information(self.admission if likely else 1.0)
        bits = COLUMNS * float((lattice.bits(self.own) * information).sum())
        return _RATE * (1 - self._headers(lattice.depth)) * bits / 8

    @cached_property
    def carriers(self) -> Carriers:
        return self.numbers.carriers(float(np.round(self.numbers.size / CELL) * CELL))

    @cached_property
    def own_rows(self) -> npt.NDArray[np.int64]:
        """[D] of the carriers those that are written, or left alone."""
        return self.carriers.one_of_each()

    @cached_property
    def own(self) -> Carriers:
        return self.carriers[self.own_rows]

    @cached_property
    def quiet(self) -> Quiet:
        return Quiet(self.model)

    @cached_property
    def alone(self) -> npt.NDArray[np.bool_]:
        """[C] carriers that are left alone."""
        return self.quiet.left_alone()[self.numbers.rows]

    def _headers(self, depth: int) -> float:
        """Of carriers, those that headers take."""
        return 1 - (1 - Kind.of(depth).share(len(self.own))) ** (UNNOTICED if depth == 1 else 1)

    @cached_property
    def likeness(self) -> Likeness:
        """Of the C carriers, for changes as one bit in a number makes them."""
        return Likeness.of(self.numbers.colours, self._positions, self._example)

    @cached_property
    def admission(self) -> float:
        """Share of the numbers of one bit that get another value where only likely ones do."""
        changed = self.numbers.colours.copy()
        rows = self.own_rows[~self.alone[self.own_rows]]
        changed[rows] = self._example[rows]
        admitted = self.likeness.admitted(self.numbers.colours, changed, np.random.default_rng(2))
        return float(admitted[rows].mean()) if len(rows) else 0.0

    @cached_property
    def _positions(self) -> Doubles:
        """[C, 3], whatever is in the model."""
        means = self.model.means.detach().cpu().double().numpy()[self.numbers.rows]
        result: Doubles = np.nan_to_num(means).clip(-1e15, 1e15)
        return result

    @cached_property
    def _example(self) -> Doubles:
        """[C, 3] colours with noise in green and blue as one bit in each makes it."""
        colours, most = self.numbers.colours.copy(), SPACING
        noise = np.random.default_rng(1).uniform(-most, most, (len(colours), COLUMNS))
        for column in range(1, 1 + COLUMNS):
            new = colours[:, column] + noise[:, column - 1]
            colours[:, column] = self.quiet.fitted(self.numbers.rows, column, new, most / 2)
        return colours

    def _information(self, admission: float) -> Doubles:
        """[D] bits that a reader is expected to have of each bit that one of them carries."""
        namesakes = self.carriers.namesakes()[self.own_rows]
        garbage = 1 - admission * (1 - _GARBAGE) * (1 - self.own.doubt) / namesakes
        result: Doubles = ~self.alone[self.own_rows] * (1 - _entropy(garbage / 2))
        return result


def bucket_of(size: int) -> int:
    """The least bucket that holds `size` bytes, or the largest of all."""
    return next((each for each in range(255) if bucket_bytes(each) >= size), 255)


def _stretched(shares: tuple[int, ...]) -> tuple[int, ...]:
    """In the same proportion, all that there is."""
    left, result = SHARES, []
    for index, share in enumerate(shares):
        result.append(left * share // sum(shares[index:]))
        left -= result[-1]
    return tuple(result)


def _entropy(chance: Doubles) -> Doubles:
    """[...] of bits that are wrong by this chance, at most a half."""
    p = chance.clip(1e-12, 0.5)
    result: Doubles = -p * np.log2(p) - (1 - p) * np.log2(1 - p)
    return result
