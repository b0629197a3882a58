"""The capacity of a model, and where a payload goes to be least visible and least detectable.

A payload is detected by the variance that writing adds. Per byte, that is least with one bit in each number
(level `ONE`). So a payload gets as large a share of the carriers as it needs at that level. A payload that
needs more gets all carriers, and the least level that holds it. A small payload is written only where that
leaves the model as likely as it was (`likelihood`).

A writer leaves some Gaussians alone. Readers need not know which: a number that was left alone reads as lost.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np

from keyss.channels.colours.carriers import Carriers
from keyss.channels.colours.header import PLACES, SHARES, bucket_bytes
from keyss.channels.colours.likelihood import Likelihood
from keyss.channels.colours.qim import COLUMNS, LEVELS, ONE, SPACING, bit_counts
from keyss.channels.colours.salt_gaussians import SALTS
from keyss.core.arrays import Doubles, Flags, Floats, Integers, doubles
from keyss.core.gaussians import Gaussians
from keyss.keys.encryption import OVERHEAD
from keyss.rendering.difference import psnr_between

UNNOTICED = 2  # secrets whose headers are always there at level ONE, if only as noise
_RATE = 0.42  # data bits for each bit of information that is expected to be read
_GARBAGE = 0.02  # share of carriers whose name changes although it seemed stable
_COMFORTABLE = 0.8  # how full a share is at level ONE, if there is room; the rest makes up for losses
_ROBUST = 0.5  # the same at other levels, if there is room: such a payload is detectable anyway
_MARGIN = 0.5  # dB by which the cost of a payload may exceed the predicted one
_INCOMPRESSIBLE = 11  # bytes by which zlib lengthens data that it cannot compress
_ROUNDED = 0.25  # share of repeated colours from which on a model is a rounded one
_WRITTEN = 0.7  # of the places of a header, at least
_LOW = np.uint32(1023)  # bits of a float that stay
_SHORT = np.uint32((1 << 20) - 1)  # a number whose last bits are all zero was typed, not trained


@dataclass(frozen=True)
class Layout:
    """Where a payload goes."""

    level: int  # see `bit_counts`
    share: float  # of the carriers
    likely: bool = False  # True if numbers keep their values where others would be less likely


@dataclass(frozen=True, eq=False)
class Capacity:
    """The capacity of a model whose views keep a PSNR of `strength` dB."""

    model: Gaussians
    carriers: Carriers
    strength: float

    @cached_property
    def bytes(self) -> int:
        """The largest packed payload; 0 if none fits."""
        if not len(self.carriers):
            return 0
        room = max(self._room(ONE) * self._affordable, self._room(self._highest))
        largest = max((bucket_bytes(each) for each in range(256) if bucket_bytes(each) <= room), default=0)
        return max(0, largest - OVERHEAD - _INCOMPRESSIBLE)

    def layouts(self, sizes: Sequence[int]) -> tuple[list[Layout], bool] | None:
        """The layouts of encrypted payloads of these sizes in bytes, and whether one tells of others.

        None if they do not fit.
        """
        padded = [bucket_bytes(bucket_of(size)) for size in sizes]
        alone = [self._layout(size) for size in padded]
        found = [each for each in alone if each is not None]
        if len(found) == len(alone) and sum(each.share for each in found) <= 1:
            return found, len(sizes) > UNNOTICED
        together = self._layout(sum(padded))
        if together is None:
            return None
        return [replace(together, share=together.share * size / sum(padded)) for size in padded], True

    def _layout(self, size: int) -> Layout | None:
        for likely, comfort in product((True, False), (_COMFORTABLE, 1.0)):
            share = size / max(comfort * self._room(ONE, likely), 1e-3)
            if share <= self._affordable:
                return Layout(ONE, share, likely)
        holds = (size <= _ROBUST * self._room(level) for level in range(1, self._highest))
        level = next((level for level, enough in enumerate(holds, start=1) if enough), self._highest)
        return Layout(level, 1.0) if self._highest and size <= self._room(level) else None

    @cached_property
    def _affordable(self) -> float:
        """Share of the carriers that may carry one bit in each number."""
        affordable = 10 ** ((self._psnr(ONE) - self.strength - _MARGIN) / 10)
        return float(min(1.0, affordable)) - 1 / SHARES  # shares are rounded up

    @cached_property
    def _highest(self) -> int:
        """The highest level at which all carriers may carry, or the level ONE."""
        levels = range(1, LEVELS)
        return bisect_left(levels, True, key=lambda each: self._psnr(each) < self.strength + _MARGIN)

    def _psnr(self, level: int) -> float:
        """PSNR in dB that views keep beside a payload in all carriers."""
        rows = self.carriers.representatives[~self.excluded[self.carriers.representatives]]
        bits = bit_counts(self.carriers.impact[rows], level)[:, None]
        places = np.random.default_rng(0).uniform(-0.5, 0.5, (len(rows), COLUMNS))  # in steps
        sh = self.model.sh.detach().clone()
        noise = places * np.where(bits > 0, SPACING * 2.0**bits, 0.0)
        sh[self.carriers.rows[rows], 0, 1:] += sh.new_tensor(noise)
        return psnr_between(self.model, replace(self.model.detach(), sh=sh))

    def _room(self, level: int, likely: bool = False) -> float:
        """Bytes that all carriers hold, from the information that a reader is expected to get."""
        rows = self.carriers.representatives
        if not len(rows):
            return 0.0
        sure = (1 - _GARBAGE) * (1 - self.carriers.error_probability[rows]) / self.carriers.name_counts[rows]
        chance = ((1 - (self.acceptance if likely else 1.0) * sure) / 2).clip(1e-12, 0.5)  # of a wrong bit
        information = 1 + chance * np.log2(chance) + (1 - chance) * np.log2(1 - chance)
        bits = COLUMNS * bit_counts(self.carriers.impact[rows], level) * information * ~self.excluded[rows]
        headers = SALTS * PLACES * (UNNOTICED if level == ONE else 1)
        return float(_RATE * np.exp(-headers / len(rows)) * bits.sum() / 8)

    @cached_property
    def statistics(self) -> ColourStatistics:
        return ColourStatistics(self.model, self.carriers.rows)

    @cached_property
    def excluded(self) -> Flags:
        """[C] carriers that are left alone."""
        return self.statistics.excluded()

    @cached_property
    def likelihood(self) -> Likelihood:
        """The likelihood of the carriers, for changes as writing makes them."""
        means = np.nan_to_num(doubles(self.model.means)[self.carriers.rows]).clip(-1e15, 1e15)
        return Likelihood.of(self.carriers.colours, means, self._example)

    @cached_property
    def acceptance(self) -> float:
        """Share of the written numbers that get another value where only likely ones do."""
        rows = self.carriers.representatives[~self.excluded[self.carriers.representatives]]
        if not len(rows):
            return 0.0
        changed = self.carriers.colours.copy()
        changed[rows] = self._example[rows]
        accepted = self.likelihood.accept(self.carriers.colours, changed, np.random.default_rng(2))
        return float(accepted[rows].mean())

    @cached_property
    def headers_may_skip(self) -> bool:
        """True if headers may do without unlikely numbers: enough of their places are still written."""
        return self.acceptance * (1 - float(self.excluded[self.carriers.representatives].mean())) > _WRITTEN

    @cached_property
    def _example(self) -> Doubles:
        """[C, 3] colours with noise in green and blue as writing adds it."""
        noise = np.random.default_rng(1).uniform(-SPACING, SPACING, (len(self.carriers), COLUMNS))
        colours = self.carriers.colours
        return np.hstack([colours[:, :1], self.statistics.imitate(colours[:, 1:] + noise)])


def bucket_of(size: int) -> int:
    """The least bucket that holds `size` bytes, or the largest of all."""
    return bisect_left(range(255), size, key=bucket_bytes)


class ColourStatistics:
    """The constant colours of a model's carriers in `rows` [C], as training or rounding left them."""

    def __init__(self, model: Gaussians, rows: Integers) -> None:
        colours: Floats = model.sh[:, 0].detach().cpu().float().numpy()
        every = [np.unique(column, return_inverse=True, return_counts=True) for column in colours.T]
        repeated = np.stack([counts[inverse.ravel()] > 1 for _, inverse, counts in every], axis=1)
        self._values = [values for values, _, _ in every]
        self._rounded = bool(len(repeated)) and float(repeated.mean()) > _ROUNDED
        self._colours, self._repeated = colours[rows], repeated[rows].any(axis=1)

    def excluded(self) -> Flags:
        """[C] carriers with a colour that is repeated, typed, or equal in two channels.

        None of a rounded model, where all are repeated. Colours that are nearly equal are not left alone:
        there would be too many of them beside those that the others were moved away from.
        """
        if self._rounded:
            return np.zeros(len(self._colours), bool)
        typed = ((self._colours.view(np.uint32) & _SHORT) == 0).any(axis=1)
        grey = (self._colours == np.roll(self._colours, 1, axis=1)).any(axis=1)
        alone: Flags = self._repeated | typed | grey
        return alone

    def imitate(self, new: Doubles) -> Floats:
        """[C, 2] `new` greens and blues as this model would have them; those that are the old ones stay.

        In a rounded model: the nearest value that it has, if a reader reads the same from it. In others: with
        the last bits of the old values, which are not quite random after training.
        """
        old = np.ascontiguousarray(self._colours[:, 1:])
        low = old.view(np.uint32) & _LOW
        fitted: Floats = (new.astype(np.float32).view(np.uint32) & ~_LOW | low).view(np.float32)
        if self._rounded:
            for column, values in enumerate(self._values[1:]):
                own = new[:, column]
                nearest = values[np.searchsorted((values[1:] + values[:-1]) / 2, own)]
                fitted[:, column] = np.where(np.abs(nearest - own) <= SPACING / 2, nearest, own)
        return np.where(new == old, old, fitted)
