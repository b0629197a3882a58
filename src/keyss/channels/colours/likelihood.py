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

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from keyss.core.arrays import Doubles, Flags, Integers
from keyss.core.neighbours import nearest_neighbours

_NEIGHBOURS = 3  # in space
_SIZES = (3e-6, 3e-4, 0.002, 0.008, 0.03, 0.12)  # of differences in colour, below which all count as the same
_LEARNED_FROM = 5_000  # Gaussians
_RIDGE, _STEPS = 3.0, 8  # of Newton's method
_BATCHES = 16  # of numbers that are decided at a time, as if none were another's neighbour


@dataclass(frozen=True)
class Likelihood:
    """How likely changes of one kind are in the colours [N, 3] of a model."""

    pairs: tuple[Integers, ...]  # [P, 2] in both directions: nearest in space, further ones, next in the file
    weights: tuple[Doubles, ...]  # [F] of the logarithm of p, of green and of blue

    @staticmethod
    def of(colours: Doubles, positions: Doubles, example: Doubles) -> Likelihood:
        """`colours`, `positions` [N, 3], finite, N above 1.

        `example` [N, 3]: the colours with changes of this kind in greens and blues.
        """
        count = len(colours)
        row, near = np.arange(count), nearest_neighbours(positions, min(_NEIGHBOURS + 1, count))[1]
        further = near[:, 2:].ravel()
        ends = ((row, near[:, 1]), (np.repeat(row, near.shape[1] - 2), further), (row[1:], row[:-1]))
        pairs = tuple(_both_ways(*each) for each in ends)
        weights = tuple(_fit_weights(pairs, colours, column, example[:, column]) for column in (1, 2))
        return Likelihood(pairs, weights)

    def accept(self, colours: Doubles, new: Doubles, random: np.random.Generator) -> Flags:
        """[N, 2] which greens and blues get the value in `new` [N, 3], one after the other."""
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
    """[P, 2] each pair of different Gaussians once in each direction."""
    both = np.concatenate([np.stack([one, other], axis=1), np.stack([other, one], axis=1)])
    return np.unique(both[both[:, 0] != both[:, 1]], axis=0).astype(np.int64)


def _features(
    every: Sequence[Integers], colours: Doubles, rows: Integers, column: int, values: Doubles
) -> Doubles:
    """[R, F] of rows [R] whose number in this column is `values` [R]."""
    others, place = (0, 3 - column), np.full(len(colours), -1)
    place[rows] = np.arange(len(rows))
    features = [_logs(values - colours[rows, other]) for other in others]
    for pairs in every:
        which, other = place[pairs[:, 0]], pairs[:, 1]
        which, other = which[which >= 0], other[which >= 0]
        apart = values[which] - colours[other, column]
        inside = [apart - (colours[rows[which], each] - colours[other, each]) for each in others]
        for difference in (apart, *inside):
            sums = [np.bincount(which, each, len(rows)) for each in _logs(difference)]
            features.append([each.astype(np.float64) for each in sums])
    return np.concatenate(features).T


def _logs(apart: Doubles) -> list[Doubles]:
    return [np.log(apart * apart + size * size) / 2 for size in _SIZES]


def _fit_weights(every: Sequence[Integers], colours: Doubles, column: int, example: Doubles) -> Doubles:
    """[F] weights of a logistic regression that tells the colours from the example."""
    rows = np.random.default_rng(0).permutation(len(colours))[:_LEARNED_FROM]
    true, changed = (
        _features(every, colours, rows, column, each[rows]) for each in (colours[:, column], example)
    )
    apart = true - changed
    spread = apart.std(axis=0) + 1e-9
    apart /= spread
    weights = np.zeros(apart.shape[1])
    for _ in range(_STEPS):
        doubt = 1 / (1 + np.exp((apart @ weights).clip(-50, 50)))
        bent = (apart * (doubt * (1 - doubt))[:, None]).T @ apart + _RIDGE * np.eye(len(weights))
        weights += np.linalg.solve(bent, apart.T @ doubt - _RIDGE * weights)
    found: Doubles = weights / spread
    return found
