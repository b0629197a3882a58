"""How much a model holds, and which carriers a payload gets: as few as it needs.

A payload that is small enough is written only where that leaves the model as likely as it was (`likeness`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from keyss.channels.colours.carriers import CELL, Carriers, Doubles, Numbers
from keyss.channels.colours.header import SHARES, UNNOTICED, bucket_bytes, header_share
from keyss.channels.colours.lattice import COLUMNS, SPACING
from keyss.channels.colours.likeness import Likeness
from keyss.channels.colours.quiet import Quiet
from keyss.core.gaussians import Gaussians
from keyss.keys.encryption import OVERHEAD

_RATE = 0.42  # data bits for each bit of information that is expected to be read
_GARBAGE = 0.02  # share of carriers whose name has changed although it seemed safe
_COMFORTABLE = 0.8  # of the capacity of a share: the less, the more may be lost
_INCOMPRESSIBLE = 11  # bytes by which zlib lengthens data that it cannot compress


@dataclass(frozen=True)
class Layout:
    """Where payloads go: each gets so many SHARES of the carriers."""

    shares: tuple[int, ...]
    likely: bool  # True if numbers keep their values where others would be less likely


@dataclass(frozen=True)
class Capacity:
    """What a model holds."""

    model: Gaussians
    numbers: Numbers

    def bytes(self, *, likely: bool = False) -> int:
        """The largest packed payload; 0 if none fits.

        `likely`: only where a new value leaves a number as likely as it was.
        """
        room = self._room(likely) if len(self.own) else 0.0
        largest = max((bucket_bytes(each) for each in range(256) if bucket_bytes(each) <= room), default=0)
        return max(0, largest - OVERHEAD - _INCOMPRESSIBLE)

    def layout(self, sizes: Sequence[int]) -> Layout | None:
        """For encrypted payloads of these sizes in bytes; None where they do not fit."""
        buckets = [bucket_bytes(bucket_of(size)) for size in sizes]
        for likely in (True, False):
            for comfort in (_COMFORTABLE, 1.0):
                room = max(comfort * self._room(likely), 1e-3)
                shares = tuple(max(1, math.ceil(SHARES * min(1e6, size / room))) for size in buckets)
                if sum(shares) <= SHARES:
                    return Layout(shares, likely)
        return None

    def _room(self, likely: bool) -> float:
        """Bytes that all carriers hold."""
        information = float(self._information(self.admission if likely else 1.0).sum())
        return _RATE * (1 - self._headers) * COLUMNS * information / 8

    @cached_property
    def carriers(self) -> Carriers:
        return self.numbers.carriers(float(np.round(self.numbers.size / CELL) * CELL))

    @cached_property
    def own_rows(self) -> npt.NDArray[np.int64]:
        """[D] the carriers that are written, or left alone."""
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

    @property
    def _headers(self) -> float:
        """Share of the carriers that headers take."""
        return 1 - (1 - header_share(len(self.own))) ** UNNOTICED

    @cached_property
    def likeness(self) -> Likeness:
        """Of the C carriers, for changes as writing makes them."""
        means = self.model.means.detach().cpu().double().numpy()[self.numbers.rows]
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
