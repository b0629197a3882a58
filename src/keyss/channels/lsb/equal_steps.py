"""Equal steps: numbers that predict each other's low bits.

Adam's steps do not depend on the size of a gradient. While one of two siblings, Gaussians that density
control split, is seen alone, or both in one direction, all harmonics of a colour move apart by the same
amount. The same holds for the distance from zero, where harmonics start, and for scales and for quaternions.
Constant colours, which are never written, move by the same amount times the ratio of two learning rates.
While two colours of a Gaussian are wrong by the same factor, the harmonics of both move together.

A Gaussian is left alone if three numbers of a group (the harmonics of a colour, a quaternion, or scales and
opacity) moved by equal amounts away from zero, from another of its colours or from one of its nearest
neighbours, up to the precision of the bits that stay. Halves of a large Gaussian may be far apart: they are
found by sums and differences of harmonics, which equal steps do not change. No rate of a trainer is assumed.
By chance two agree in many Gaussians; whether these predict low bits is tested on each model, at each depth.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from keyss.channels.lsb.bits import DEEPEST, LEAST, LOW, Layout, bit_patterns
from keyss.core.arrays import Flags, Integers, Words32, doubles
from keyss.core.gaussians import Gaussians
from keyss.core.neighbours import Neighbours
from keyss.files.formats.common import morton_order
from keyss.kernels.jit import inline, kernel
from keyss.kernels.parallel import in_blocks

_NEIGHBOURS = 8  # searched for siblings; with 12, detectors that look at 12 find as little
_EQUAL = 3  # equal steps that exclude a Gaussian
_PARTNERS, _WINDOW = 2, 1 << 8  # distant siblings per Gaussian, and candidates for them
_ROWS = 1 << 11  # rows per batch of a thread
_SAMPLE = 8000  # Gaussians whose pairs of numbers are tested
_DRAWS = 16
_PARTS = np.array([[1 / 16], [1 / 8], [1 / 4]])  # tested distances, in cells
_ZERO, _COLOURS, _NOTHING = -1, -2, -3  # what a Gaussian is compared with, instead of another one
_KINDS = _GEOMETRY, _HARMONICS, _BETWEEN_COLOURS = 0, 1, 2
_FIRST = 16  # place of the harmonics of degrees 1 to 3 among a Gaussian's numbers
_LANES = 48  # padded number of these harmonics
_BLOCK = 16  # points of a sweep that are compared at a time
_NAN, _EXPONENT, _MAGNITUDE = np.uint32(0x7FC00000), np.uint32(0x7F800000), np.uint32(0x7FFFFFFF)


class Steps:
    """The numbers of a model, and pairs of its Gaussians that may be siblings.

    A *cell* is the range of a number's low bits at a depth.
    """

    def __init__(self, gaussians: Gaussians, layout: Layout) -> None:
        means = np.nan_to_num(doubles(gaussians.means), posinf=0, neginf=0)
        near = min(_NEIGHBOURS, max(0, len(means) - 1))
        self.order = morton_order(means.astype(np.float32))  # what neighbours share stays in the cache
        self.others = np.full((len(means), 2 + near), _ZERO, np.int32)  # candidates for siblings
        self.others[:, 1] = _COLOURS
        if near:
            means = means.take(self.order, axis=0)
            tree = Neighbours(means, near + 1)

            def search(start: int, stop: int) -> None:
                nearest = tree.of(means[start:stop])[1][:, 1:]
                self.others[self.order[start:stop], 2:] = self.order[nearest]

            def drop(start: int, stop: int) -> None:
                _drop_mutual(self.order[start:stop], self.others)

            in_blocks(search, len(means), _ROWS)
            in_blocks(drop, len(means), _ROWS, _drop_mutual)
        self.words = _words(gaussians, layout)
        self.distant = _distant_siblings(self.words[1])

    def equal(self, depth: int, among: Flags | None = None) -> Flags:
        """Mask [N] of Gaussians that moved by equal amounts, by the bits that stay at a depth.

        `among` [N]: those that did at a larger depth, where steps are less exact.
        """
        rows, distant = self.order, self.distant
        if among is not None:
            rows, distant = rows[among[rows]], distant[:, among[distant[0]]]
        moved = np.zeros(len(self.order), bool)

        def mark(start: int, stop: int) -> None:
            block = rows[start:stop]
            _mark(block, self.others.take(block, axis=0), *self.words, depth, moved)

        in_blocks(mark, len(rows), _ROWS, _mark)
        _mark(distant[0], distant[1, :, None].astype(np.int32), *self.words, depth, moved)
        return moved

    def chance(self, depth: int, usable: Flags) -> float:
        """p-value of low bits that follow from each other, for new low bits of the `usable` [N] Gaussians.

        Compares the number of equal differences of two numbers with those after new draws of the low bits:
        one-sided Poisson tests, Bonferroni-corrected.
        """
        from scipy.special import pdtrc  # takes long to load

        rows, random, chances = self.order[usable[self.order]], np.random.default_rng(0), [1.0]
        rows = rows[:: max(1, len(rows) // _SAMPLE)]
        entries, count = np.empty((0, 7), np.uint32), 0
        while count == len(entries):
            entries = np.empty((2 * len(entries) + len(rows) + 1, 7), np.uint32)
            count = _list(rows, self.others[rows][:, 1:], *self.words, depth, entries)
        for kind in _KINDS:
            listed = entries[:count][entries[:count, 6] == kind]
            words, written = listed[:, :4], usable[np.tile(listed[:, 4:6], 2)]
            hits, drawn = _hits(words, depth), np.zeros(len(_PARTS))
            for _ in range(_DRAWS):
                drawn += _hits(redrawn(words, written, depth, random), depth)
            chances += pdtrc(hits - 1.0, np.maximum(drawn, 1) / _DRAWS)[hits > 0].tolist()
        return min(1.0, min(chances) * len(_KINDS) * len(_PARTS))


def moved_from_zero(gaussians: Gaussians, layout: Layout) -> Flags:
    """Mask [N] of Gaussians whose numbers moved by equal amounts away from zero, at the least depth."""
    moved, rows = np.zeros(len(gaussians), bool), np.arange(len(gaussians))
    _mark(rows, np.full((len(rows), 1), _ZERO, np.int32), *_words(gaussians, layout), LEAST, moved)
    return moved


def redrawn(words: Words32, chosen: Flags, depth: int, random: np.random.Generator) -> Words32:
    """`words` [...] with new low bits of those `chosen` [...]."""
    mask, new = np.uint32((1 << depth) - 1 << 1), words.copy()
    drawn = random.integers(0, 1 << depth, words[chosen].shape, np.uint32) << np.uint32(1)
    new[chosen] = new[chosen] & ~mask | drawn
    return new


def _words(gaussians: Gaussians, layout: Layout) -> tuple[Words32, Words32]:
    """Bit patterns of what may move by equal steps.

    Scales and opacity [N, 4] or, each beside a part of the quaternion, [N, 8]; harmonics of all colours
    [N, 3 K], the constant ones first.
    """
    geometry = torch.cat([gaussians.log_scales, gaussians.opacity_logits[:, None]], dim=1)
    if layout.quats:
        geometry = torch.stack([geometry, gaussians.quats], dim=2)
    return bit_patterns(geometry), bit_patterns(gaussians.sh)


def _distant_siblings(sh: Words32) -> Integers:
    """[2, P] Gaussians in which the harmonics of degree 1 of a colour may have moved by equal amounts.

    For any signs of the steps, two sums or differences are equal, up to the precision of the bits that stay.
    """

    def search(task: int, _: int) -> Integers:
        words, sign = np.ascontiguousarray(sh[:, 3 + task // 2 : 12 : 3].T), np.float32(1 - task % 2 * 2)
        first, second, third = (words & ~LOW | (LOW + 1) >> 1).view(np.float32)
        cells = (words & _EXPONENT).view(np.float32).max(axis=0) * np.float32(2.0 ** (DEEPEST + 2 - 23))
        with np.errstate(over="ignore", invalid="ignore"):
            sums = first + sign * second
            others = first + third, first - third
        sums[np.isnan(sums)] = np.inf  # the sign of NaN depends on the processor
        # Sorted with their rows in the lower half: the same on all processors, and faster than `argsort`.
        keys = sums.view(np.int32)
        keys = (keys ^ (keys >> 31 & 0x7FFFFFFF)).astype(np.int64) << 32 | np.arange(len(keys))
        keys.sort()
        order, pairs = keys & 0xFFFFFFFF, []
        sums, cells = sums[order], cells[order]
        for other in others:
            partners = np.empty((_PARTNERS * len(order), 2), np.int64)
            count = _sweep(sums, np.pad(other[order], (0, _BLOCK)), cells, partners)
            pairs.append(order[partners[:count].T])
        return np.concatenate(pairs, axis=1)

    colours = in_blocks(search, 6 if sh.shape[1] > 3 else 0, 1, _sweep)
    return np.concatenate([np.empty((2, 0), np.int64), *colours], axis=1)


def _hits(words: Words32, depth: int) -> Integers:
    """Counts of rows (a, b, c, d) of `words` [M, 4] in which b - a and d - c agree up to _PARTS of a cell."""
    numbers = words.view(np.float32).astype(np.float64)
    steps = abs(numbers[:, 1::2] - numbers[:, ::2])
    cells = (words & _EXPONENT).view(np.float32).max(axis=1) * 2.0 ** (depth + 1 - 23)
    counts: Integers = (abs(steps[:, 1] - steps[:, 0]) < _PARTS * cells).sum(axis=1)
    return counts


@kernel
def _sweep(first: Any, second: Any, cells: Any, pairs: Any) -> int:
    """List pairs of points (first, second) that agree within `cells` [N]; return their number.

    `first` is ascending; `second` [N + _BLOCK] is padded.
    """
    count = 0
    for one in range(len(first)):
        most, end = count + _PARTNERS, min(one + _WINDOW, len(first))
        for start in range(one + 1, end, _BLOCK):
            if count == most or first[start] - first[one] >= cells[one]:
                break
            near = 0
            for at in range(start, start + _BLOCK):
                near += abs(second[at] - second[one]) < cells[one]
            for other in range(start, min(start + _BLOCK, end) if near else start):
                if count == most or first[other] - first[one] >= cells[one]:
                    break
                if abs(second[other] - second[one]) < cells[one]:
                    pairs[count, 0], pairs[count, 1] = one, other
                    count += 1
    return count


@kernel
def _drop_mutual(rows: Any, others: Any) -> None:
    """Keep each pair of mutual neighbours once, in the first row: the other one gets _NOTHING."""
    for one in rows:
        for column in range(2, others.shape[1]):
            other = others[one, column]
            for its in range(2, others.shape[1] if other < one else 0):
                if others[other, its] == one:
                    others[one, column] = _NOTHING


@inline
def _read(geometry: Any, sh: Any, row: Any, words: Any) -> None:
    """Set `words` [_FIRST + _LANES] to the numbers of a Gaussian."""
    row = np.uint64(row)  # unsigned indices, which are not tested for being negative, take half of the time
    for at in range(np.uint64(geometry.shape[1])):
        words[at] = geometry[row, at]
    for at in range(np.uint64(3), np.uint64(sh.shape[1])):  # constant colours are never written
        words[at + np.uint64(_FIRST - 3)] = sh[row, at]


@inline
def _read_other(geometry: Any, sh: Any, row: Any, x: Any, y: Any) -> None:
    """Set `y` to the numbers of what a Gaussian with the numbers x is compared with.

    For _COLOURS, the next colours, with the signs of x; geometry is equal to nothing.
    """
    if row >= 0:
        _read(geometry, sh, row, y)
        return
    for at in range(_FIRST + _LANES):
        y[at] = np.uint32(0) if row == _ZERO else _NAN
    for at in range(_LANES if row == _COLOURS else 0):
        following = _FIRST + at // 3 * 3 + (at + 1) % 3
        y[_FIRST + at] = x[following] & _MAGNITUDE | x[_FIRST + at] & ~_MAGNITUDE


@inline
def _compare(x: Any, y: Any, depth: Any, known: Any, steps: Any, cells: Any) -> None:
    """Set `steps` and `cells` to the differences of x and y by the bits that stay at a depth.

    `cells`: the larger one of x and y. `known` [3, _FIRST + _LANES]: scratch memory.
    """
    low, half = np.uint32((1 << depth + 1) - 1), np.uint32(1 << depth)
    share, numbers = np.float32(2.0 ** (depth + 1 - 23)), known.view(np.float32)
    for at in range(_FIRST + _LANES):
        known[0, at], known[1, at] = x[at] & ~low | half, y[at] & ~low | half
        known[2, at] = max(x[at] & _EXPONENT, y[at] & _EXPONENT)
    for at in range(_FIRST + _LANES):
        steps[at] = abs(numbers[0, at] - numbers[1, at])
        cells[at] = numbers[2, at] * share


@inline
def _agree(steps: Any, cells: Any, one: Any, other: Any) -> Any:
    return abs(steps[one] - steps[other]) <= max(cells[one], cells[other])


@inline
def _most_pairs(steps: Any, cells: Any, first: Any, lanes: Any, lags: Any, groups: Any, count: Any) -> Any:
    """How many pairs of numbers agree in groups of `count`, from lane `first` on, at most.

    Fast, because it compares all numbers of a ring with those 1 to `lags` further: half of their number.
    """
    pairs, start, stride = np.int32(0), np.uint64(first), np.uint64(groups)
    for at in range(start, start + np.uint64(lanes // 2)):
        again = at + np.uint64(groups * count)
        steps[again], cells[again] = steps[at], cells[at]
    for at in range(start, start + np.uint64(lanes)):
        for lag in range(lags):
            pairs += np.int32(_agree(steps, cells, at, at + np.uint64(lag + 1) * stride))
    return pairs


@inline
def _most_equal(steps: Any, cells: Any, first: Any, groups: Any, count: Any) -> Any:
    """How many of the `count` numbers of a group agree with one of them, at most; see `_most_pairs`."""
    most, end = 0, first + groups * count
    for one in range(first, end):
        equal = 0
        for other in range(first + (one - first) % groups, end, groups):
            equal += _agree(steps, cells, one, other)
        most = max(most, equal)
    return most


@kernel
def _mark(rows: Any, others: Any, geometry: Any, sh: Any, depth: int, moved: Any) -> None:
    """Set `moved` [N] for `rows` [R] and `others` [R, K] in which _EQUAL numbers of a group moved equally."""
    quats, harmonics, size = geometry.shape[1] // 4, sh.shape[1] // 3 - 1, _FIRST + _LANES
    x, y, known = np.full(size, _NAN), np.full(size, _NAN), np.empty((3, size), np.uint32)
    steps, cells = np.full(2 * size, np.float32(np.nan)), np.zeros(2 * size, np.float32)
    for row in range(len(rows)):
        one = rows[row]
        _read(geometry, sh, one, x)
        for column in range(others.shape[1]):
            other = others[row, column]
            if other == _NOTHING or (moved[one] and (other < 0 or moved[other])):
                continue
            _read_other(geometry, sh, other, x, y)
            _compare(x, y, depth, known, steps, cells)
            pairs = _most_pairs(steps, cells, 0, 8, 2, quats, 4)
            pairs += _most_pairs(steps, cells, _FIRST, _LANES, 7, 3, harmonics)
            if pairs < _EQUAL - 1:
                continue
            equal = _most_equal(steps, cells, 0, quats, 4)
            if max(equal, _most_equal(steps, cells, _FIRST, 3, harmonics)) >= _EQUAL:
                moved[one] = True
                if other >= 0:
                    moved[other] = True


@kernel
def _list(rows: Any, others: Any, geometry: Any, sh: Any, depth: int, entries: Any) -> int:
    """List two numbers that differ by equal steps in `rows` [R] and `others` [R, K]; return how many.

    `entries` [M, 7]: first number of both Gaussians, second number, the Gaussians (one for _COLOURS), kind.
    Lists at most M. Steps of up to two cells are small by chance.
    """
    quats, size, count = geometry.shape[1] // 4, _FIRST + _LANES, 0
    x, y, known = np.full(size, _NAN), np.full(size, _NAN), np.empty((3, size), np.uint32)
    steps, cells = np.empty(size, np.float32), np.empty(size, np.float32)
    for row in range(len(rows)):
        one = rows[row]
        _read(geometry, sh, one, x)
        for other in others[row]:
            _read_other(geometry, sh, other, x, y)
            _compare(x, y, depth, known, steps, cells)
            for at in range(size):
                first, groups = (0, quats) if at < _FIRST else (_FIRST, 3)
                for second in range(first + (at - first) % groups, at, groups):
                    if _agree(steps, cells, at, second) and steps[at] > 2 * max(cells[at], cells[second]):
                        if count == len(entries):
                            return count
                        entry = entries[count]
                        entry[0], entry[1], entry[2], entry[3] = x[at], y[at], x[second], y[second]
                        entry[4], entry[5], entry[6] = one, max(one, other), _GEOMETRY
                        if at >= _FIRST:
                            entry[6] = _HARMONICS if other >= 0 else _BETWEEN_COLOURS
                        count += 1
    return count
