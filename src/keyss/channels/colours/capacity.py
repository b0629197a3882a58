"""The capacity of a model, and where a payload goes to be least visible and least detectable.

A payload is detected by the variance that writing adds. Per byte, that is least with one bit in each number
(depth 1). So a payload gets as large a share of the carriers as it needs at that depth. A payload that needs
more gets all carriers, and the least depth and level that hold it.

A payload that is small enough is written only where that leaves the model as likely as it was (`likeness`).

A writer leaves some Gaussians alone. Readers need not know which: a number that was left alone reads as lost.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from keyss.channels.colours.carriers import CELL, Carriers, Numbers
from keyss.channels.colours.header import SHARES, UNNOTICED, Kind, bucket_bytes
from keyss.channels.colours.lattice import COLUMNS, LEVELS, MAX_BITS, SPACING, bit_counts
from keyss.channels.colours.likeness import Likeness
from keyss.core.arrays import Doubles, Flags, Floats, Integers, doubles
from keyss.core.gaussians import Gaussians
from keyss.keys.encryption import OVERHEAD
from keyss.rendering.difference import psnr_between

_RATE = 0.42  # data bits for each bit of information that is expected to be read
_GARBAGE = 0.02  # share of carriers whose name changes although it seemed stable
_COMFORTABLE = 0.8  # how full a share may be; the rest makes up for losses
_ROBUST = 0.5  # the same for a payload that is detectable anyway
SPREAD = 0.5  # dB by which a file may stay below `Capacity.psnr`
_INCOMPRESSIBLE = 11  # bytes by which zlib lengthens data that it cannot compress
_ROUNDED = 0.25  # share of repeated colours from which on a model is a rounded one
_LOW = np.uint32(1023)  # bits of a float that stay
_SHORT = np.uint32((1 << 20) - 1)  # a number whose last bits are all zero was typed, not trained


@dataclass(frozen=True)
class Layout:
    """Where payloads go: each gets so many SHARES of the carriers."""

    level: int  # see `bit_counts`
    depth: int
    shares: tuple[int, ...]
    likely: bool = False  # True if numbers keep their values where others would be less likely


@dataclass(frozen=True)
class Capacity:
    """The capacity of a model."""

    model: Gaussians
    numbers: Numbers
    strength: float  # dB PSNR that views keep
    measured: dict[tuple[int, int], float] = field(default_factory=dict, compare=False)  # see `psnr`

    def bytes(self, depth: int) -> int:
        """The largest packed payload with up to `depth` bits in a number; 0 if none fits."""
        room = self._room(self._level(depth), depth) if len(self.own) else 0.0
        largest = max((bucket_bytes(each) for each in range(256) if bucket_bytes(each) <= room), default=0)
        return max(0, largest - OVERHEAD - _INCOMPRESSIBLE)

    def layout(self, sizes: Sequence[int]) -> Layout | None:
        """The layout of encrypted payloads of these sizes in bytes; None if they do not fit."""
        level = self._level(1)
        for likely in (True, False):
            for comfort in (_COMFORTABLE, 1.0):
                shares = self._shares(sizes, level, 1, comfort, likely)
                if sum(shares) <= SHARES:
                    return Layout(level, 1, shares, likely)
        for comfort in (_ROBUST, 1.0):
            for depth in range(2, MAX_BITS + 1):
                level = self._least_level(sizes, depth, comfort)
                shares = self._shares(sizes, level, depth, comfort)
                if sum(shares) <= SHARES and self.psnr(level, depth) >= self.strength + SPREAD:
                    return Layout(level, depth, _stretched(shares))
        level = self._level(MAX_BITS)
        shares = self._shares(sizes, level, MAX_BITS, 1.0)
        return Layout(level, MAX_BITS, _stretched(shares)) if sum(shares) <= SHARES else None

    def psnr(self, level: int, depth: int) -> float:
        """PSNR in dB that views keep beside a payload in all carriers and its headers."""
        if (level, depth) not in self.measured:
            random, bits = np.random.default_rng(0), bit_counts(self.own, level, depth)
            places = random.uniform(-0.5, 0.5, (len(bits), COLUMNS))  # in steps
            kind = Kind.of(depth)
            bits[random.random(len(bits)) < self._headers(depth)] = kind.depth
            steps = np.where((bits > 0) & ~self.alone[self.own_rows], SPACING * 2.0**bits, 0.0)
            noise = places * steps[:, None]
            sh = self.model.sh.detach().clone()
            sh[self.numbers.rows[self.own_rows], 0, 1:] += sh.new_tensor(noise)
            self.measured[level, depth] = psnr_between(self.model, replace(self.model.detach(), sh=sh))
        return self.measured[level, depth]

    def _level(self, depth: int) -> int:
        """The highest level of this depth whose PSNR is at least `strength`, or the lowest one."""

        def is_below(level: int) -> bool:
            return self.psnr(level, depth) < self.strength + SPREAD

        if not is_below(LEVELS - 1):  # as mostly at depth 1
            return LEVELS - 1
        return max(0, bisect_left(range(LEVELS), True, key=is_below) - 1)

    def _least_level(self, sizes: Sequence[int], depth: int, comfort: float) -> int:
        """The lowest level of this depth that holds payloads of these sizes, or the highest of all."""

        def holds(level: int) -> bool:
            return sum(self._shares(sizes, level, depth, comfort)) <= SHARES

        return bisect_left(range(LEVELS - 1), True, key=holds)

    def _shares(
        self, sizes: Sequence[int], level: int, depth: int, comfort: float, likely: bool = False
    ) -> tuple[int, ...]:
        room = max(comfort * self._room(level, depth, likely), 1e-3)
        buckets = [bucket_bytes(bucket_of(size)) for size in sizes]
        return tuple(max(1, math.ceil(SHARES * min(1e6, size / room))) for size in buckets)

    def _room(self, level: int, depth: int, likely: bool = False) -> float:
        """The number of bytes that all carriers hold."""
        information = self._information(self.admission if likely else 1.0)
        bits = COLUMNS * float((bit_counts(self.own, level, depth) * information).sum())
        return _RATE * (1 - self._headers(depth)) * bits / 8

    @cached_property
    def carriers(self) -> Carriers:
        return self.numbers.carriers(float(np.round(self.numbers.size / CELL) * CELL))

    @cached_property
    def own_rows(self) -> Integers:
        """[D] the carriers that are written, or left alone."""
        return self.carriers.one_of_each()

    @cached_property
    def own(self) -> Carriers:
        return self.carriers[self.own_rows]

    @cached_property
    def quiet(self) -> Quiet:
        return Quiet(self.model)

    @cached_property
    def alone(self) -> Flags:
        """[C] carriers that are left alone."""
        return self.quiet.left_alone()[self.numbers.rows]

    def _headers(self, depth: int) -> float:
        """Share of the carriers that headers take."""
        return 1 - (1 - Kind.of(depth).share(len(self.own))) ** (UNNOTICED if depth == 1 else 1)

    @cached_property
    def likeness(self) -> Likeness:
        """The likeness of the C carriers, for changes as writing makes them."""
        means = doubles(self.model.means)[self.numbers.rows]
        return Likeness.of(self.numbers.colours, np.nan_to_num(means).clip(-1e15, 1e15), self._example)

    @cached_property
    def admission(self) -> float:
        """Share of the written numbers that get another value where only likely ones do."""
        changed = self.numbers.colours.copy()
        rows = self.own_rows[~self.alone[self.own_rows]]
        changed[rows] = self._example[rows]
        admitted = self.likeness.admitted(self.numbers.colours, changed, np.random.default_rng(2))
        return float(admitted[rows].mean()) if len(rows) else 0.0

    @cached_property
    def _example(self) -> Doubles:
        """[C, 3] colours with noise in green and blue as writing adds it."""
        colours = self.numbers.colours.copy()
        noise = np.random.default_rng(1).uniform(-SPACING, SPACING, (len(colours), COLUMNS))
        for column in range(1, 1 + COLUMNS):
            new = colours[:, column] + noise[:, column - 1]
            colours[:, column] = self.quiet.fitted(self.numbers.rows, column, new)
        return colours

    def _information(self, admission: float) -> Doubles:
        """[D] bits of information that a reader is expected to get from each written bit."""
        namesakes = self.carriers.namesakes()[self.own_rows]
        garbage = 1 - admission * (1 - _GARBAGE) * (1 - self.own.doubt) / namesakes
        chance = (garbage / 2).clip(1e-12, 0.5)
        entropy = -chance * np.log2(chance) - (1 - chance) * np.log2(1 - chance)
        information: Doubles = ~self.alone[self.own_rows] * (1 - entropy)
        return information


def bucket_of(size: int) -> int:
    """The least bucket that holds `size` bytes, or the largest of all."""
    return next((each for each in range(255) if bucket_bytes(each) >= size), 255)


def _stretched(shares: tuple[int, ...]) -> tuple[int, ...]:
    """All SHARES, in the same proportion."""
    left, stretched = SHARES, []
    for index, share in enumerate(shares):
        stretched.append(left * share // sum(shares[index:]))
        left -= stretched[-1]
    return tuple(stretched)


class Quiet:
    """The constant colours of a model with N Gaussians, as training or rounding left them."""

    def __init__(self, model: Gaussians) -> None:
        self._colours: Floats = model.sh[:, 0].detach().cpu().float().numpy()
        every = [np.unique(column, return_inverse=True, return_counts=True) for column in self._colours.T]
        repeated = np.stack([counts[inverse.ravel()] > 1 for _, inverse, counts in every], axis=1)
        self._values = [values for values, _, _ in every]
        self._rounded = bool(len(repeated)) and float(repeated.mean()) > _ROUNDED
        self._repeated = repeated.any(axis=1)

    def left_alone(self) -> Flags:
        """[N] Gaussians with a colour that is repeated, typed, or equal in two channels.

        None of a rounded model, where all are repeated. Colours that are nearly equal are not left alone:
        there would be too many of them beside those that the others were moved away from.
        """
        if self._rounded or not len(self._colours):
            return np.zeros(len(self._colours), bool)
        typed = ((self._colours.view(np.uint32) & _SHORT) == 0).any(axis=1)
        alone: Flags = self._repeated | typed
        alone |= (self._colours == np.roll(self._colours, 1, axis=1)).any(axis=1)
        return alone

    def fitted(self, rows: Integers, column: int, new: Doubles) -> Floats:
        """[R] `new` values of a column as this model would have them.

        In a rounded model: the nearest value that it has, if a reader reads the same from it. In others: with
        the last bits of the old values, which are not quite random after training.
        """
        old, values = self._colours[rows, column], self._values[column]
        if self._rounded:
            above = np.searchsorted(values, new).clip(1, len(values) - 1) if len(values) > 1 else 0
            below = values[np.maximum(above - 1, 0)]
            nearest = np.where(new - below < values[above] - new, below, values[above])
            return np.where(np.abs(nearest - new) <= SPACING / 2, nearest, new).astype(np.float32)
        bits = new.astype(np.float32).view(np.uint32) & ~_LOW | old.view(np.uint32) & _LOW
        same: Floats = bits.view(np.float32)
        return same
