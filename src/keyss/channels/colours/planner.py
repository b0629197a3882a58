"""The capacity of a model's colours, and the least visible and least detectable layout of a payload.

A payload is detectable by the variance that writing adds, which is smallest per byte with one bit per value
(level `ONE`). A payload gets the share of the carriers that it needs at that level. If it needs more than may
be changed, it gets all carriers and the lowest level that holds it.

A writer excludes conspicuous Gaussians. A small payload changes only values whose new value is as likely as
the old one. Readers need not know which values changed: an unchanged one reads as lost.

Colours are correlated: neighbours in space, Gaussians split from one parent, and the channels of a grey
Gaussian differ by little, so noise is easy to detect there. A value therefore changes with the Metropolis
(1953) probability min(1, p(new) / p(old)), which leaves the distribution p invariant. Logistic regression
between the model and a copy with such changes learns p(new) / p(old) (noise-contrastive estimation, Gutmann
and Hyvärinen 2010). Features are logarithms of colour distances, softened at several sizes; their sums model
the heavy tails of such differences.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np

from keyss.channels.colours.carriers import SALTS, Carriers
from keyss.channels.colours.header import PLACES, SHARES, bucket_bytes
from keyss.channels.colours.qim import COLUMNS, LEVELS, ONE, SPACING, bit_counts
from keyss.core.arrays import Doubles, Flags, Floats, Integers, doubles
from keyss.core.gaussians import Gaussians
from keyss.core.neighbours import nearest_neighbours
from keyss.keys.encryption import OVERHEAD
from keyss.rendering.orbit import psnr_between

MIN_HEADERS = 2  # minimum number of headers in a file at level ONE; those without a secret are noise
_RATE = 0.42  # data bits per expected bit of information
_GARBAGE = 0.02  # share of carriers whose ID changes although it seemed stable
STRENGTH = 45.0  # minimum PSNR in dB between views of the stego model and of the cover
_COMFORTABLE = 0.8  # load of a share at level ONE, if that is enough; the rest compensates for losses
_ROBUST = 0.5  # load of a share at other levels, at which a payload is detectable anyway
_MARGIN = 0.5  # dB by which the actual cost of a payload may exceed the predicted cost
_ROUNDED = 0.25  # minimum share of repeated colours in a rounded model
_WRITTEN = 0.7  # minimum share of a header's places that are written
_NEIGHBOURS = 3  # nearest neighbours, whose colours predict a Gaussian's
_SIZES = (3e-6, 3e-4, 0.002, 0.008, 0.03, 0.12)  # colour differences at which the logarithm levels off
_SAMPLE = 5_000  # Gaussians for the regression
_RIDGE, _STEPS = 3.0, 8  # penalty; steps of Newton's method
_BATCHES = 16  # values in one batch are decided as if none were neighbours
_LOW = np.uint32(1023)  # bits of a float that stay
_SHORT = np.uint32((1 << 20) - 1)  # floats in which these bits are zero were typed, not trained


@dataclass(frozen=True)
class Layout:
    """The level of a payload, and its share of the carriers."""

    level: int  # see `bit_counts`
    share: float
    likely: bool = False  # True if only likely values are written


@dataclass(frozen=True, eq=False)
class Planner:
    """Plans payloads for a model whose views keep a PSNR of STRENGTH."""

    model: Gaussians
    carriers: Carriers

    @cached_property
    def bytes(self) -> int:
        """The largest packed payload; 0 if none fits."""
        if not len(self.carriers):
            return 0
        limit = max(self._level_bytes(ONE) * self._max_share, self._level_bytes(self._max_level))
        largest = max(
            (bucket_bytes(index) for index in range(256) if bucket_bytes(index) <= limit), default=0
        )
        return max(0, largest - OVERHEAD)

    @cached_property
    def share_with_another(self) -> float:
        """The least share of the capacity that the header of another secret leaves."""
        if not self.bytes:
            return 1.0
        level, few = (self._max_level, 1) if self._max_level else (ONE, MIN_HEADERS)
        return self._level_bytes(level, few + 1) / self._level_bytes(level, few)

    def layouts(self, sizes: Sequence[int]) -> tuple[list[Layout], bool] | None:
        """The layouts of encrypted payloads of these sizes in bytes, and True if one reveals others.

        None if they do not fit.
        """
        padded = [bucket_bytes(bucket_of(size)) for size in sizes]
        independent = [self._layout(size, len(sizes)) for size in padded]
        layouts = [layout for layout in independent if layout is not None]
        if len(layouts) == len(independent) and sum(layout.share for layout in layouts) <= 1:
            return layouts, len(sizes) > MIN_HEADERS
        together = self._layout(sum(padded), len(sizes))
        if together is None:
            return None
        return [replace(together, share=together.share * size / sum(padded)) for size in padded], True

    def _layout(self, size: int, secrets: int) -> Layout | None:
        for likely, comfort in product((True, False), (_COMFORTABLE, 1.0)):
            share = size / max(comfort * self._level_bytes(ONE, secrets, likely), 1e-3)
            if share <= self._max_share:
                return Layout(ONE, share, likely)
        holds = (size <= _ROBUST * self._level_bytes(level, secrets) for level in range(1, self._max_level))
        level = next((level for level, enough in enumerate(holds, start=1) if enough), self._max_level)
        return Layout(level, 1.0) if self._max_level and size <= self._level_bytes(level, secrets) else None

    @cached_property
    def _max_share(self) -> float:
        """The maximum share of the carriers at level ONE that keeps STRENGTH."""
        share = 10 ** ((self._psnr(ONE) - STRENGTH - _MARGIN) / 10)
        return float(min(1.0, share)) - 1 / SHARES  # shares are rounded up

    @cached_property
    def _max_level(self) -> int:
        """The highest level that keeps STRENGTH with all carriers; ONE if there is none."""
        levels = range(1, LEVELS)
        return bisect_left(levels, True, key=lambda level: self._psnr(level) < STRENGTH + _MARGIN)

    def is_visible(self, stego: Gaussians) -> bool:
        """True if views of `stego` do not keep STRENGTH."""
        return psnr_between(self.model, stego) < STRENGTH

    def _psnr(self, level: int) -> float:
        """PSNR of the model's views, in dB, after writing all carriers at `level`."""
        rows = self.writable
        bits = bit_counts(self.carriers.impact[rows], level)[:, None]
        places = np.random.default_rng(0).uniform(-0.5, 0.5, (len(rows), COLUMNS))  # in steps
        sh = self.model.sh.detach().clone()
        noise = places * np.where(bits > 0, SPACING * 2.0**bits, 0.0)
        sh[self.carriers.rows[rows], 0, 1:] += sh.new_tensor(noise)
        return psnr_between(self.model, replace(self.model.detach(), sh=sh))

    def _level_bytes(self, level: int, secrets: int = 1, likely: bool = False) -> float:
        """Bytes that all carriers hold, from the expected information of a reader.

        A reader does not know which carriers the headers of other secrets take.
        """
        rows, ids = self.writable, len(self.carriers.representatives)
        if not ids:
            return 0.0
        headers, taken = MIN_HEADERS if level == ONE else 1, SALTS * PLACES / ids
        sure = (1 - _GARBAGE) * self.carriers.certainty[rows] * (self.acceptance if likely else 1.0)
        sure *= np.exp(-taken * max(0, secrets - headers))
        error = ((1 - sure) / 2).clip(1e-12, 0.5)  # per bit
        information = 1 + error * np.log2(error) + (1 - error) * np.log2(1 - error)
        bits = COLUMNS * bit_counts(self.carriers.impact[rows], level) * information
        return float(_RATE * np.exp(-taken * headers) * bits.sum() / 8)

    @cached_property
    def statistics(self) -> ColourStatistics:
        return ColourStatistics(self.model, self.carriers.rows)

    @cached_property
    def writable(self) -> Integers:
        """The carriers [W] that may be written: of each ID one, unless its colour is conspicuous."""
        rows = self.carriers.representatives
        return rows[~self.statistics.conspicuous()[rows]]

    @cached_property
    def likelihood(self) -> Likelihood:
        """The likelihood of changes such as writing makes."""
        means = np.nan_to_num(doubles(self.model.means)[self.carriers.rows]).clip(-1e15, 1e15)
        return Likelihood.of(self.carriers.colours, means, self._noisy_colours)

    @cached_property
    def acceptance(self) -> float:
        """The share of new values that `likelihood` accepts."""
        if not len(self.writable):
            return 0.0
        changed = self.carriers.colours.copy()
        changed[self.writable] = self._noisy_colours[self.writable]
        accepted = self.likelihood.accept(self.carriers.colours, changed, np.random.default_rng(2))
        return float(accepted[self.writable].mean())

    @cached_property
    def headers_may_skip(self) -> bool:
        """True if headers may skip unlikely values, because enough of their places are still written."""
        return self.acceptance * len(self.writable) > _WRITTEN * len(self.carriers.representatives)

    @cached_property
    def _noisy_colours(self) -> Doubles:
        """Colours [C, 3] with noise in green and blue such as writing adds."""
        noise = np.random.default_rng(1).uniform(-SPACING, SPACING, (len(self.carriers), COLUMNS))
        return self.statistics.imitate(self.carriers.colours[:, 1:] + noise)


def bucket_of(size: int) -> int:
    """The smallest bucket that holds `size` bytes; the largest of all if none does."""
    return bisect_left(range(255), size, key=bucket_bytes)


class ColourStatistics:
    """Statistics of constant colours that training or rounding left; carriers are in `rows` [C]."""

    def __init__(self, model: Gaussians, rows: Integers) -> None:
        colours: Floats = model.sh[:, 0].detach().cpu().float().numpy()
        every = [np.unique(column, return_inverse=True, return_counts=True) for column in colours.T]
        repeated = np.stack([counts[inverse.ravel()] > 1 for _, inverse, counts in every], axis=1)
        self._values = [values for values, _, _ in every]
        self._rounded = bool(len(repeated)) and float(repeated.mean()) > _ROUNDED
        self._colours, self._repeated = colours[rows], repeated[rows].any(axis=1)

    def conspicuous(self) -> Flags:
        """Mask [C] of carriers with a colour that is repeated, typed, or equal in two channels.

        Empty for a rounded model, where all are repeated. Nearly equal colours are not excluded: unchanged,
        they would be conspicuously many among the changed ones.
        """
        if self._rounded:
            return np.zeros(len(self._colours), bool)
        typed = ((self._colours.view(np.uint32) & _SHORT) == 0).any(axis=1)
        grey = (self._colours == np.roll(self._colours, 1, axis=1)).any(axis=1)
        excluded: Flags = self._repeated | typed | grey
        return excluded

    def imitate(self, new: Doubles) -> Doubles:
        """The colours [C, 3] with `new` greens and blues [C, 2], given the statistics of the model.

        In a rounded model, they take the nearest of its values from which a reader reads the same. In others,
        they keep the last bits of the old values, which are not quite random after training.
        """
        old = np.ascontiguousarray(self._colours[:, 1:])
        low = old.view(np.uint32) & _LOW
        values: Floats = (new.astype(np.float32).view(np.uint32) & ~_LOW | low).view(np.float32)
        if self._rounded:
            for column, existing in enumerate(self._values[1:]):
                wanted = new[:, column]
                nearest = existing[np.searchsorted((existing[1:] + existing[:-1]) / 2, wanted)]
                values[:, column] = np.where(np.abs(nearest - wanted) <= SPACING / 2, nearest, wanted)
        values = np.where(new == old, old, values)
        return np.hstack([self._colours[:, :1], values]).astype(np.float64)


@dataclass(frozen=True)
class Likelihood:
    """A model of log p for changes of one kind in colours [N, 3]."""

    pairs: tuple[Integers, ...]  # [P, 2] in both directions: nearest in space, others in space, next in file
    weights: tuple[Doubles, ...]  # [F] for green and for blue

    @staticmethod
    def of(colours: Doubles, positions: Doubles, example: Doubles) -> Likelihood:
        """Learn from finite `colours` and `positions` [N, 3], N above 1.

        `example` [N, 3]: the colours with such changes in green and blue.
        """
        count = len(colours)
        row, near = np.arange(count), nearest_neighbours(positions, min(_NEIGHBOURS + 1, count))[1]
        further = near[:, 2:].ravel()
        ends = ((row, near[:, 1]), (np.repeat(row, near.shape[1] - 2), further), (row[1:], row[:-1]))
        pairs = tuple(_both_ways(*pair) for pair in ends)
        weights = tuple(_fit_weights(pairs, colours, column, example[:, column]) for column in (1, 2))
        return Likelihood(pairs, weights)

    def accept(self, colours: Doubles, new: Doubles, random: np.random.Generator) -> Flags:
        """Mask [N, 2] of the greens and blues that take their value in `new` [N, 3], decided in sequence."""
        colours, changed = colours.copy(), new != colours
        accepted = np.zeros((len(colours), 2), bool)
        batch = random.integers(0, _BATCHES, len(colours))
        for index in range(_BATCHES):
            for column, weights in enumerate(self.weights, start=1):
                rows = np.flatnonzero((batch == index) & changed[:, column])
                before, after = (
                    _features(self.pairs, colours, rows, column, values[rows, column])
                    for values in (colours, new)
                )
                ratio = (after - before) @ weights  # log of p(new) / p(old)
                fine = rows[np.log(random.uniform(1e-300, 1, len(rows))) < ratio]
                colours[fine, column] = new[fine, column]
                accepted[fine, column - 1] = True
        return accepted


def _both_ways(one: Integers, other: Integers) -> Integers:
    """Pairs [P, 2] of different Gaussians, each once per direction."""
    both = np.concatenate([np.stack([one, other], axis=1), np.stack([other, one], axis=1)])
    return np.unique(both[both[:, 0] != both[:, 1]], axis=0).astype(np.int64)


def _features(
    every: Sequence[Integers], colours: Doubles, rows: Integers, column: int, values: Doubles
) -> Doubles:
    """Features [R, F] of `rows` [R] with `values` [R] in `column`."""
    others, place = (0, 3 - column), np.full(len(colours), -1)
    place[rows] = np.arange(len(rows))
    features = [_logs(values - colours[rows, other]) for other in others]
    for pairs in every:
        which, other = place[pairs[:, 0]], pairs[:, 1]
        which, other = which[which >= 0], other[which >= 0]
        difference = values[which] - colours[other, column]
        inside = [
            difference - (colours[rows[which], channel] - colours[other, channel]) for channel in others
        ]
        for apart in (difference, *inside):
            sums = [np.bincount(which, values, len(rows)) for values in _logs(apart)]
            features.append([feature.astype(np.float64) for feature in sums])
    return np.concatenate(features).T


def _logs(difference: Doubles) -> list[Doubles]:
    return [np.log(difference * difference + size * size) / 2 for size in _SIZES]


def _fit_weights(every: Sequence[Integers], colours: Doubles, column: int, example: Doubles) -> Doubles:
    """Weights [F] of a logistic regression between the colours and the example."""
    rows = np.random.default_rng(0).permutation(len(colours))[:_SAMPLE]
    true, changed = (
        _features(every, colours, rows, column, side[rows]) for side in (colours[:, column], example)
    )
    difference = true - changed
    spread = difference.std(axis=0) + 1e-9
    difference /= spread
    weights = np.zeros(difference.shape[1])
    for _ in range(_STEPS):
        error = 1 / (1 + np.exp((difference @ weights).clip(-50, 50)))
        hessian = (difference * (error * (1 - error))[:, None]).T @ difference + _RIDGE * np.eye(len(weights))
        weights += np.linalg.solve(hessian, difference.T @ error - _RIDGE * weights)
    normalised: Doubles = weights / spread
    return normalised
