"""Which changes of colour leave a model as training might have left it.

Colours are not independent: neighbours in space, Gaussians that were split from one, and the channels of a
grey one differ by little. Noise shows where they differ least. So a number gets its new value with the
probability of Metropolis (1953), p(new) / p(old) if that is less than one, and keeps the old one otherwise:
this leaves the distribution p as it was. Readers need not know: a number that kept its value reads as lost.

The ratio p(new) / p(old) is learned from the model itself by logistic regression on the difference between
the model and the same model with changes (noise-contrastive estimation, Gutmann and Hyvärinen 2010). Features
are logarithms of distances in colour, softened at several sizes, which sum to the heavy tails of such
differences.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from keyss.core.arrays import Doubles, Flags, Integers
from keyss.core.neighbours import nearest_neighbours

_NEIGHBOURS = 3  # in space
_SIZES = (3e-6, 3e-4, 0.002, 0.008, 0.03, 0.12)  # of differences in colour, below which all count as the same
_RELATIVE = (0.1, 0.5, 2.0)  # of differences beside those in red between neighbours
_MIN_RED = 0.002
_LEARNED_FROM = 5_000  # Gaussians
_RIDGE, _STEPS = 3.0, 8  # of Newton's method
_BATCHES = 16  # of numbers that are decided at a time, as if none were another's neighbour


@dataclass(frozen=True)
class _Pairs:
    """Each Gaussian with others of one kind, in both directions."""

    starts: Integers  # [N + 1]
    others: Integers  # [P]

    @staticmethod
    def of(one: Integers, other: Integers, count: int) -> _Pairs:
        both = np.stack([np.concatenate([one, other]), np.concatenate([other, one])], axis=1)
        both = np.unique(both[both[:, 0] != both[:, 1]], axis=0)
        starts = np.concatenate([[0], np.cumsum(np.bincount(both[:, 0], minlength=count))])
        return _Pairs(starts.astype(np.int64), both[:, 1])

    def around(self, rows: Integers) -> tuple[Integers, Integers]:
        """[p] which of the rows [R], and [p] what is paired with it."""
        counts = self.starts[rows + 1] - self.starts[rows]
        which = np.repeat(np.arange(len(rows)), counts)
        first = np.repeat(self.starts[rows] - np.cumsum(counts) + counts, counts)
        return which, self.others[first + np.arange(len(which))]


@dataclass(frozen=True)
class Likeness:
    """How likely changes of one kind are in the colours [N, 3] of a model."""

    pairs: tuple[_Pairs, ...]  # nearest in space, further ones, next in the file
    usual: Doubles  # [N] how much red, which is never written, differs from that of neighbours
    weights: tuple[Doubles, Doubles]  # [F] of the logarithm of p, of green and of blue

    @staticmethod
    def of(colours: Doubles, positions: Doubles, example: Doubles) -> Likeness:
        """`colours`, `positions` [N, 3], finite, N above 1.

        `example` [N, 3]: the colours with changes of this kind in greens and blues.
        """
        count = len(colours)
        near = nearest_neighbours(positions, min(_NEIGHBOURS + 1, count))[1]
        row = np.arange(count)
        nearest = _Pairs.of(row, near[:, 1], count)
        further = _Pairs.of(np.repeat(row, near.shape[1] - 2), near[:, 2:].ravel(), count)
        pairs = (nearest, further, _Pairs.of(row[1:], row[:-1], count))
        usual = _usual(colours, pairs[:2])
        weights = [_learned(pairs, usual, colours, column, example[:, column]) for column in (1, 2)]
        return Likeness(pairs, usual, (weights[0], weights[1]))

    def admitted(self, colours: Doubles, new: Doubles, random: np.random.Generator) -> Flags:
        """[N, 2] which greens and blues get the value in `new` [N, 3], one after the other."""
        colours, changed = colours.copy(), new != colours
        admitted = np.zeros((len(colours), 2), bool)
        batch = random.integers(0, _BATCHES, len(colours))
        for index in range(_BATCHES):
            for column in (1, 2):
                rows = np.flatnonzero((batch == index) & changed[:, column])
                around = [pairs.around(rows) for pairs in self.pairs]
                before, after = (
                    _features(self.usual, colours, rows, column, values[rows, column], around)
                    for values in (colours, new)
                )
                ratio = (after - before) @ self.weights[column - 1]  # log of p(new) / p(old)
                fine = rows[np.log(random.uniform(1e-300, 1, len(rows))) < ratio]
                colours[fine, column] = new[fine, column]
                admitted[fine, column - 1] = True
        return admitted


def _features(
    usual: Doubles,
    colours: Doubles,
    rows: Integers,
    column: int,
    values: Doubles,
    around: list[tuple[Integers, Integers]],
) -> Doubles:
    """[R, F] of rows whose number in this column is `values` [R]."""
    another = 3 - column
    features: list[Doubles] = []
    for which, other in around:
        apart = values[which] - colours[other, column]
        own = rows[which]
        red, third = (colours[own, each] - colours[other, each] for each in (0, another))
        for each in (apart, apart - red, apart - third):
            features += [_sums(which, _log(each, size), len(rows)) for size in _SIZES]
        relative = apart / usual[own]
        features += [_sums(which, _log(relative, size), len(rows)) for size in _RELATIVE]
    for own_channel in (0, another):
        inside = values - colours[rows, own_channel]
        features += [_log(inside, size) for size in _SIZES]
    return np.stack(features, axis=1)


def _learned(
    every: tuple[_Pairs, ...], usual: Doubles, colours: Doubles, column: int, example: Doubles
) -> Doubles:
    """[F] weights of a logistic regression that tells the colours from the example."""
    rows = np.random.default_rng(0).permutation(len(colours))[:_LEARNED_FROM]
    around = [pairs.around(rows) for pairs in every]
    true = _features(usual, colours, rows, column, colours[rows, column], around)
    apart = true - _features(usual, colours, rows, column, example[rows], around)
    spread = apart.std(axis=0) + 1e-9
    apart /= spread
    weights = np.zeros(apart.shape[1])
    for _ in range(_STEPS):
        doubt = 1 / (1 + np.exp((apart @ weights).clip(-50, 50)))
        bent = (apart * (doubt * (1 - doubt))[:, None]).T @ apart + _RIDGE * np.eye(len(weights))
        weights += np.linalg.solve(bent, apart.T @ doubt - _RIDGE * weights)
    found: Doubles = weights / spread
    return found


def _usual(colours: Doubles, every: tuple[_Pairs, ...]) -> Doubles:
    """[N] geometric means of differences in red between what is paired."""
    logs, counts = np.zeros(len(colours)), np.zeros(len(colours))
    for pairs in every:
        which, other = pairs.around(np.arange(len(colours)))
        logs += np.bincount(which, _log(colours[which, 0] - colours[other, 0], _MIN_RED), len(logs))
        counts += np.bincount(which, minlength=len(logs))
    found: Doubles = np.exp(logs / counts.clip(1)) + _MIN_RED
    return found


def _sums(which: Integers, values: Doubles, count: int) -> Doubles:
    """[count] of the values [p] of each."""
    return np.bincount(which, values, count).astype(np.float64)


def _log(apart: Doubles, size: float) -> Doubles:
    return np.log(apart * apart + size * size) / 2
