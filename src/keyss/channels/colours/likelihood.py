"""Accept changes of colour so that the distribution of colours stays the same.

Colours are correlated: neighbours in space, Gaussians split from one parent, and the channels of a grey
Gaussian differ by little, so noise is easy to detect there. A value therefore changes with the Metropolis
(1953) probability min(1, p(new) / p(old)), which leaves the distribution p invariant. Readers need not know
which values changed: an unchanged one reads as lost.

Logistic regression between the model and a copy with such changes learns p(new) / p(old)
(noise-contrastive estimation, Gutmann and Hyvärinen 2010). Features are logarithms of colour distances,
softened at several sizes; their sums model the heavy tails of such differences.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from keyss.core.arrays import Doubles, Flags, Integers
from keyss.core.neighbours import nearest_neighbours

_NEIGHBOURS = 3  # in space
_SIZES = (3e-6, 3e-4, 0.002, 0.008, 0.03, 0.12)  # colour differences at which the logarithm levels off
_SAMPLE = 5_000  # Gaussians for the regression
_RIDGE, _STEPS = 3.0, 8  # penalty; steps of Newton's method
_BATCHES = 16  # values in one batch are decided as if none were neighbours


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
        pairs = tuple(_both_ways(*each) for each in ends)
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
        inside = [difference - (colours[rows[which], each] - colours[other, each]) for each in others]
        for apart in (difference, *inside):
            sums = [np.bincount(which, each, len(rows)) for each in _logs(apart)]
            features.append([each.astype(np.float64) for each in sums])
    return np.concatenate(features).T


def _logs(difference: Doubles) -> list[Doubles]:
    return [np.log(difference * difference + size * size) / 2 for size in _SIZES]


def _fit_weights(every: Sequence[Integers], colours: Doubles, column: int, example: Doubles) -> Doubles:
    """Weights [F] of a logistic regression between the colours and the example."""
    rows = np.random.default_rng(0).permutation(len(colours))[:_SAMPLE]
    true, changed = (
        _features(every, colours, rows, column, each[rows]) for each in (colours[:, column], example)
    )
    difference = true - changed
    spread = difference.std(axis=0) + 1e-9
    difference /= spread
    weights = np.zeros(difference.shape[1])
    for _ in range(_STEPS):
        error = 1 / (1 + np.exp((difference @ weights).clip(-50, 50)))
        hessian = (difference * (error * (1 - error))[:, None]).T @ difference + _RIDGE * np.eye(len(weights))
        weights += np.linalg.solve(hessian, difference.T @ error - _RIDGE * weights)
    found: Doubles = weights / spread
    return found
