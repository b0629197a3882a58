"""Equal steps: harmonics that predict each other's low bits.

Adam's steps do not depend on the size of a gradient. While one of two siblings, Gaussians that density
control split, is seen alone, or both in one direction, all harmonics of a colour move apart by the same
amount. The same holds for the distance from zero, where harmonics start, and for scales and for quaternions.
Constant colours, which are never written, move by the same amount times the ratio of two learning rates.

A Gaussian is left alone if three numbers of a group (the harmonics of a colour, a quaternion, or scales and
opacity) moved by equal amounts away from zero or from one of its nearest neighbours, up to the precision of
the bits that stay. No rate of a trainer is assumed. By chance two agree in many Gaussians; whether these
predict low bits is tested on each model, at each depth.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from keyss.channels.lsb.bits import GEOMETRY, LEAST, QUATS, Layout, used_words
from keyss.core.arrays import Flags, Integers, Words32, doubles
from keyss.core.gaussians import Gaussians
from keyss.core.neighbours import Neighbours
from keyss.files.formats.common import morton_order
from keyss.kernels.jit import kernel
from keyss.kernels.parallel import in_blocks

_NEIGHBOURS = 12  # siblings were among the nearest 10 in models of 20,000 to 200,000 Gaussians
_EQUAL = 3  # numbers
_ROWS = 1 << 11  # that a thread takes at a time
_SAMPLE = 8000  # Gaussians whose pairs of numbers are tested
_DRAWS = 16
_PARTS = np.array([1 / 16, 1 / 8, 1 / 4], np.float32)  # of a cell


class Steps:
    """The numbers of a model, and the nearest neighbours of its Gaussians.

    A *cell* is the range of a number's low bits at a depth.
    """

    def __init__(self, gaussians: Gaussians, layout: Layout) -> None:
        means = np.nan_to_num(doubles(gaussians.means), posinf=0, neginf=0)
        self.order = morton_order(means.astype(np.float32))  # neighbours are near in memory, too
        means, count = means[self.order], len(means)
        self.near = np.empty((count, min(_NEIGHBOURS, max(0, count - 1))), np.int32)
        self.words = _no_words(gaussians, layout, count)  # in `order`
        tree = Neighbours(means, self.near.shape[1] + 1) if self.near.size else None

        def gather(start: int, stop: int) -> None:
            used = used_words(gaussians[torch.from_numpy(self.order[start:stop])])
            _fill(self.words, start, stop, used)
            if tree:
                self.near[start:stop] = tree.of(means[start:stop])[1][:, 1:]

        in_blocks(gather, count, _ROWS)

    def equal(self, depth: int) -> Flags:
        """Mask [N] of Gaussians that moved by equal amounts, by the bits that stay at a depth."""
        apart = np.zeros(len(self.order), bool)

        def mark(start: int, stop: int) -> None:
            for words in self.words:
                _mark(start, stop, self.near, words, depth, apart)

        in_blocks(mark, len(apart), _ROWS)
        found = np.empty_like(apart)
        found[self.order] = apart
        return found

    def chance(self, depth: int, usable: Flags) -> float:
        """p-value of low bits that follow from each other, for new low bits of the `usable` [N] Gaussians.

        Compares the number of equal differences of two numbers with those after new draws of the low bits:
        one-sided Poisson tests, Bonferroni-corrected.
        """
        from scipy.special import pdtrc  # takes long to load

        own = usable[self.order]
        rows = np.flatnonzero(own)
        rows = rows[:: max(1, len(rows) // _SAMPLE)]
        near = np.concatenate([rows[:, None], self.near[rows]], axis=1)
        at, places = np.unique(near, return_inverse=True)
        places, random, chances = places.reshape(near.shape).astype(np.int32), np.random.default_rng(0), [1.0]
        for every in self.words:
            words, drawn = every[at], np.zeros(len(_PARTS), np.int64)
            hits = _equal_pairs(places, words, words, depth)
            for _ in range(_DRAWS):
                drawn += _equal_pairs(places, words, redrawn(words, own[at], depth, random), depth)
            chances += pdtrc(hits - 1.0, np.maximum(drawn, 1) / _DRAWS)[hits > 0].tolist()
        return min(1.0, min(chances) * len(self.words) * len(_PARTS))


def moved_from_zero(gaussians: Gaussians, layout: Layout) -> Flags:
    """Mask [N] of Gaussians whose numbers moved by equal amounts away from zero, at the least depth."""
    moved = np.zeros(len(gaussians), bool)

    def mark(start: int, stop: int) -> None:
        size = stop - start
        words, none = _no_words(gaussians, layout, size), np.empty((size, 0), np.int32)
        _fill(words, 0, size, used_words(gaussians[start:stop]))
        for each in words:
            _mark(0, size, none, each, LEAST, moved[start:stop])

    in_blocks(mark, len(moved), _ROWS, _mark)
    return moved


def _no_words(gaussians: Gaussians, layout: Layout, count: int) -> list[Words32]:
    """Arrays [count, groups, members] for the bit patterns of what may move by equal steps."""
    words = [np.empty((count, 1 + layout.quats, 4), np.uint32)]
    if gaussians.sh_degree:
        words.append(np.empty((count, 3, (gaussians.sh_degree + 1) ** 2 - 1), np.uint32))
    return words


def _fill(words: list[Words32], start: int, stop: int, used: Words32) -> None:
    """Set rows of `words` to those of `used` [R, F]."""
    geometry = words[0][start:stop]
    geometry[:, 0, :3], geometry[:, 0, 3] = used[:, :3], used[:, GEOMETRY - 1]
    geometry[:, 1:] = used[:, None, QUATS]
    for harmonics in words[1:]:
        harmonics[start:stop] = used[:, GEOMETRY:].reshape(stop - start, -1, 3).transpose(0, 2, 1)


def redrawn(words: Words32, chosen: Flags, depth: int, random: np.random.Generator) -> Words32:
    """`words` [N, ...] with new low bits of the `chosen` [N] rows."""
    mask, new = np.uint32((1 << depth) - 1 << 1), words.copy()
    drawn = random.integers(0, 1 << depth, words[chosen].shape, np.uint32) << np.uint32(1)
    new[chosen] = new[chosen] & ~mask | drawn
    return new


def _equal_pairs(places: Integers, known: Words32, words: Words32, depth: int) -> Any:
    counts = np.zeros(len(_PARTS), np.int64)
    _count_equal(places, known, words, depth, _PARTS, counts)
    return counts


@kernel
def _mark(start: int, stop: int, near: Any, words: Any, depth: int, apart: Any) -> None:
    """Set `apart` [N] for pairs of rows `start` to `stop` and their neighbours in `near` [N, K], or zero."""
    size = words.shape[2]
    low, half, exponent = np.uint32((1 << depth + 1) - 1), np.uint32(1 << depth), np.uint32(0x7F800000)
    share = np.float32(2.0 ** (depth + 1 - 23))
    x, y, top = np.empty(size, np.uint32), np.zeros(size, np.uint32), np.empty(size, np.uint32)
    own, its, span = x.view(np.float32), y.view(np.float32), top.view(np.float32)
    steps = np.empty(size, np.float32)
    for one in range(start, stop):
        for place in range(near.shape[1] + 1):
            other = one if place == 0 else near[one, place - 1]
            if (apart[one] and apart[other]) or (place > 0 and other == one):
                continue
            seen = False  # a pair of mutual neighbours is judged once
            for each in range(near.shape[1] if other < one else 0):
                seen |= near[other, each] == one
            if seen:
                continue
            for group in range(words.shape[1]):
                for at in range(size):
                    x[at] = words[one, group, at]
                    y[at] = words[other, group, at] if place > 0 else np.uint32(0)
                for at in range(size):
                    top[at] = max(x[at] & exponent, y[at] & exponent)
                    x[at] = x[at] & ~low | half
                    y[at] = y[at] & ~low | half
                for at in range(size):
                    steps[at] = abs(own[at] - its[at])
                    span[at] = span[at] * share
                most = 0
                for at in range(size):
                    agree = 0
                    for each in range(size):
                        agree += abs(steps[at] - steps[each]) <= max(span[at], span[each])
                    most = max(most, agree)
                if most >= _EQUAL:
                    apart[one] = apart[other] = True
                    break


@kernel
def _count_equal(places: Any, known: Any, words: Any, depth: int, parts: Any, counts: Any) -> None:
    """Count pairs of numbers whose differences between rows of `words` agree to `parts` of a cell.

    Of those that agree in `known`, by the bits that stay. `places` [R, 1 + K]: rows and their neighbours.
    """
    size = words.shape[2]
    low, half, exponent = np.uint32((1 << depth + 1) - 1), np.uint32(1 << depth), np.uint32(0x7F800000)
    share = np.float32(2.0 ** (depth + 1 - 23))
    x, y, top = np.empty(size, np.uint32), np.empty(size, np.uint32), np.empty(size, np.uint32)
    own, its, span = x.view(np.float32), y.view(np.float32), top.view(np.float32)
    coarse, exact = np.empty(size, np.float32), np.empty(size, np.float64)
    for row in range(len(places)):
        one = places[row, 0]
        for place in range(1, places.shape[1]):
            other = places[row, place]
            if other <= one:  # each pair counts once
                continue
            for group in range(words.shape[1]):
                for at in range(size):
                    x[at], y[at] = words[one, group, at], words[other, group, at]
                for at in range(size):
                    exact[at] = abs(np.float64(own[at]) - np.float64(its[at]))
                    x[at], y[at] = known[one, group, at], known[other, group, at]
                for at in range(size):
                    top[at] = max(x[at] & exponent, y[at] & exponent)
                    x[at] = x[at] & ~low | half
                    y[at] = y[at] & ~low | half
                for at in range(size):
                    coarse[at] = abs(own[at] - its[at])
                    span[at] = span[at] * share
                for at in range(size):
                    for each in range(at):
                        cell = max(span[at], span[each])
                        if abs(coarse[at] - coarse[each]) <= cell and coarse[at] > 2 * cell:
                            off = abs(exact[at] - exact[each])
                            for part in range(len(parts)):
                                counts[part] += off < parts[part] * cell
