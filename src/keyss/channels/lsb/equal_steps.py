"""Equal steps: harmonics that predict each other's low bits.

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

_NEIGHBOURS = 8  # most siblings; detectors that look at 12 find no more than with 12 here
_EQUAL = 3  # numbers
_ALIKE, _FURTHER = 2, 1 << 8  # pairs of a Gaussian by sums of three harmonics, and how many are looked at
_ROWS = 1 << 11  # that a thread takes at a time
_SAMPLE = 8000  # Gaussians whose pairs of numbers are tested
_DRAWS = 16
_PARTS = np.array([[1 / 16], [1 / 8], [1 / 4]])  # of a cell
_ZERO, _COLOURS = -1, -2  # what a Gaussian is compared with, instead of another one
_KINDS = _GEOMETRY, _HARMONICS, _BETWEEN_COLOURS = 0, 1, 2
_FEW, _LANES = 4, 16  # numbers of a group: geometry, and harmonics; as many as a processor compares at once
_NAN, _EXPONENT, _MAGNITUDE = np.uint32(0x7FC00000), np.uint32(0x7F800000), np.uint32(0x7FFFFFFF)


class Steps:
    """The numbers of a model, and pairs of its Gaussians that may be siblings.

    A *cell* is the range of a number's low bits at a depth.
    """

    def __init__(self, gaussians: Gaussians, layout: Layout) -> None:
        means = np.nan_to_num(doubles(gaussians.means), posinf=0, neginf=0)
        self.order = morton_order(means.astype(np.float32))  # what neighbours share stays in the cache
        self.near = np.empty((len(means), min(_NEIGHBOURS, max(0, len(means) - 1))), np.int32)
        if self.near.size:
            tree = Neighbours(means, self.near.shape[1] + 1)

            def search(start: int, stop: int) -> None:
                rows = self.order[start:stop]
                self.near[rows] = tree.of(means[rows])[1][:, 1:]

            in_blocks(search, len(means), _ROWS)
        self.words = _words(gaussians, layout)
        self.alike = _alike(self.words[1])

    def equal(self, depth: int, among: Flags | None = None) -> Flags:
        """Mask [N] of Gaussians that moved by equal amounts, by the bits that stay at a depth.

        `among` [N]: those that did at a larger depth, where steps are less exact.
        """
        rows, alike = self.order, self.alike
        if among is not None:
            rows, alike = rows[among[rows]], alike[among[alike[:, 0]]]
        apart = np.zeros(len(self.order), bool)

        def mark(start: int, stop: int) -> None:
            _mark(self._pairs(rows[start:stop], _COLOURS, _ZERO), *self.words, depth, apart)

        in_blocks(mark, len(rows), _ROWS, _mark)
        _mark(alike, *self.words, depth, apart)
        return apart

    def chance(self, depth: int, usable: Flags) -> float:
        """p-value of low bits that follow from each other, for new low bits of the `usable` [N] Gaussians.

        Compares the number of equal differences of two numbers with those after new draws of the low bits:
        one-sided Poisson tests, Bonferroni-corrected.
        """
        from scipy.special import pdtrc  # takes long to load

        rows, random, chances = self.order[usable[self.order]], np.random.default_rng(0), [1.0]
        rows = rows[:: max(1, len(rows) // _SAMPLE)]
        pairs = self._pairs(rows, _COLOURS)
        pairs = pairs[(pairs[:, 1] < 0) | (pairs[:, 0] < pairs[:, 1])]  # each counts once
        found, count = np.empty((0, 7), np.uint32), 0
        while count == len(found):
            found = np.empty((2 * len(found) + len(rows) + 1, 7), np.uint32)
            count = _list(pairs, *self.words, depth, found)
        for kind in _KINDS:
            own = found[:count][found[:count, 6] == kind]
            words, written = own[:, :4], usable[np.tile(own[:, 4:6], 2)]
            hits, drawn = _hits(words, depth), np.zeros(len(_PARTS))
            for _ in range(_DRAWS):
                drawn += _hits(redrawn(words, written, depth, random), depth)
            chances += pdtrc(hits - 1.0, np.maximum(drawn, 1) / _DRAWS)[hits > 0].tolist()
        return min(1.0, min(chances) * len(_KINDS) * len(_PARTS))

    def _pairs(self, rows: Integers, *others: int) -> Integers:
        """[P, 2] pairs of `rows` [R] with `others` and with their nearest neighbours."""
        every = [np.full((len(rows), 1), other) for other in others] + [self.near[rows]]
        beside = np.concatenate(every, axis=1)
        return np.stack([rows.repeat(beside.shape[1]), beside.ravel()], axis=1)


def moved_from_zero(gaussians: Gaussians, layout: Layout) -> Flags:
    """Mask [N] of Gaussians whose numbers moved by equal amounts away from zero, at the least depth."""
    apart = np.zeros(len(gaussians), bool)
    pairs = np.stack([np.arange(len(apart)), np.full(len(apart), _ZERO)], axis=1)
    _mark(pairs, *_words(gaussians, layout), LEAST, apart)
    return apart


def redrawn(words: Words32, chosen: Flags, depth: int, random: np.random.Generator) -> Words32:
    """`words` [...] with new low bits of those `chosen` [...]."""
    mask, new = np.uint32((1 << depth) - 1 << 1), words.copy()
    drawn = random.integers(0, 1 << depth, words[chosen].shape, np.uint32) << np.uint32(1)
    new[chosen] = new[chosen] & ~mask | drawn
    return new


def _words(gaussians: Gaussians, layout: Layout) -> tuple[Words32, Words32]:
    """Bit patterns of what may move by equal steps.

    Scales and opacity [N, 4, 1] or, with quaternions, [N, 4, 2]; all coefficients of all colours [N, K, 3].
    """
    geometry = torch.cat([gaussians.log_scales, gaussians.opacity_logits[:, None]], dim=1)[:, :, None]
    if layout.quats:
        geometry = torch.cat([geometry, gaussians.quats[:, :, None]], dim=2)
    sh = gaussians.sh
    return bit_patterns(geometry).reshape(geometry.shape), bit_patterns(sh).reshape(sh.shape)


def _alike(sh: Words32) -> Integers:
    """[P, 2] Gaussians in which the harmonics of degree 1 of a colour may have moved by equal amounts.

    For any signs of the steps, two sums or differences are equal, up to the precision of the bits that stay.
    """

    def search(colour: int, _: int) -> Integers:
        words, pairs = np.ascontiguousarray(sh[:, 1:4, colour].T), list[Integers]()
        numbers = (words & ~LOW | (LOW + 1) >> 1).view(np.float32)
        cells = (words & _EXPONENT).view(np.float32).max(axis=0) * np.float32(2.0 ** (DEEPEST + 2 - 23))
        for signs in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
            with np.errstate(over="ignore", invalid="ignore"):
                one, other = (numbers[0] + sign * numbers[at] for at, sign in enumerate(signs, 1))
            order = one.argsort(kind="stable")  # the same on every processor
            found = np.empty((_ALIKE * len(order), 2), np.int64)
            pairs.append(order[found[: _meet(one[order], other[order], cells[order], found)]])
        return np.concatenate(pairs)

    colours = in_blocks(search, 3 if sh.shape[1] > 1 else 0, 1, _meet)
    return np.concatenate([np.empty((0, 2), np.int64), *colours])


def _hits(words: Words32, depth: int) -> Integers:
    """Counts of rows (a, b, c, d) of `words` [M, 4] in which b - a and d - c agree up to _PARTS of a cell."""
    numbers = words.view(np.float32).astype(np.float64)
    steps = abs(numbers[:, 1::2] - numbers[:, ::2])
    cells = (words & _EXPONENT).view(np.float32).max(axis=1) * 2.0 ** (depth + 1 - 23)
    counts: Integers = (abs(steps[:, 1] - steps[:, 0]) < _PARTS * cells).sum(axis=1)
    return counts


@kernel
def _meet(first: Any, second: Any, cells: Any, found: Any) -> int:
    """List pairs of points (first, second), by ascending `first`, that agree within `cells` [N]; how many."""
    count = 0
    for one in range(len(first)):
        most = count + _ALIKE
        for other in range(one + 1, min(one + _FURTHER, len(first))):
            if count == most or first[other] - first[one] >= cells[one]:
                break
            if abs(second[other] - second[one]) < cells[one]:
                found[count, 0], found[count, 1] = one, other
                count += 1
    return count


@inline
def _read(geometry: Any, sh: Any, row: Any, words: Any) -> None:
    """Set `words` [groups, _LANES] to the numbers of a Gaussian."""
    quats = geometry.shape[2]
    for group in range(quats):
        for at in range(4):
            words[group, at] = geometry[row, at, group]
    for at in range(1, sh.shape[1]):  # constant colours are never written
        for colour in range(len(words) - quats):
            words[quats + colour, at - 1] = sh[row, at, colour]


@inline
def _read_other(geometry: Any, sh: Any, row: Any, x: Any, y: Any) -> None:
    """Set `y` [groups, _LANES] to the numbers of what a Gaussian with the numbers x is compared with.

    For _COLOURS, the next colours, with the signs of x; geometry is equal to nothing.
    """
    if row >= 0:
        _read(geometry, sh, row, y)
    for group in range(len(x) if row < 0 else 0):
        source = geometry.shape[2] + (group - geometry.shape[2] + 1) % 3
        for at in range(_LANES):
            y[group, at] = np.uint32(0) if row == _ZERO else _NAN
            if row == _COLOURS and group >= geometry.shape[2]:
                y[group, at] = x[source, at] & _MAGNITUDE | x[group, at] & ~_MAGNITUDE


@inline
def _compare(x: Any, y: Any, depth: Any, known: Any, steps: Any, cells: Any) -> None:
    """Set `steps` [groups, _LANES] to the differences of x and y by the bits that stay at a depth.

    `cells`: the larger one of x and y. `known` [3, groups, _LANES]: scratch memory.
    """
    low, half = np.uint32((1 << depth + 1) - 1), np.uint32(1 << depth)
    share = np.float32(2.0 ** (depth + 1 - 23))
    numbers = known.view(np.float32)
    for group in range(len(x)):
        for at in range(_LANES):
            a, b = x[group, at], y[group, at]
            known[0, group, at], known[1, group, at] = a & ~low | half, b & ~low | half
            known[2, group, at] = max(a & _EXPONENT, b & _EXPONENT)
        for at in range(_LANES):
            steps[group, at] = abs(numbers[0, group, at] - numbers[1, group, at])
            cells[group, at] = numbers[2, group, at] * share


@inline
def _most_equal(steps: Any, cells: Any, group: Any, lanes: Any) -> Any:
    """The largest number of equal steps among the first `lanes` of a group."""
    most = np.int32(0)
    for at in range(lanes):
        agree = np.int32(0)
        for each in range(lanes):
            cell = max(cells[group, at], cells[group, each])
            agree += np.int32(abs(steps[group, at] - steps[group, each]) <= cell)
        most = max(most, agree)
    return most


@kernel
def _mark(pairs: Any, geometry: Any, sh: Any, depth: int, apart: Any) -> None:
    """Set `apart` [N] for `pairs` [P, 2] in which _EQUAL numbers of a group moved by equal amounts."""
    groups, last = geometry.shape[2] + 3 * (sh.shape[1] > 1), -1
    x = np.full((groups, _LANES), _NAN, np.uint32)  # unused lanes are equal to nothing
    y, known = np.zeros((groups, _LANES), np.uint32), np.empty((3, groups, _LANES), np.uint32)
    steps, cells = np.empty((groups, _LANES), np.float32), np.empty((groups, _LANES), np.float32)
    for pair in range(len(pairs)):
        one, other = pairs[pair]
        if apart[one] and (other < 0 or apart[other]):
            continue
        if one != last:
            _read(geometry, sh, one, x)
            last = one
        _read_other(geometry, sh, other, x, y)
        _compare(x, y, depth, known, steps, cells)
        equal = False
        for group in range(groups):
            if group < geometry.shape[2]:
                equal |= _most_equal(steps, cells, group, _FEW) >= _EQUAL
            else:
                equal |= _most_equal(steps, cells, group, _LANES) >= _EQUAL
        if equal:
            apart[one] = True
            if other >= 0:
                apart[other] = True


@kernel
def _list(pairs: Any, geometry: Any, sh: Any, depth: int, found: Any) -> int:
    """List two numbers that differ by equal steps in `pairs` [P, 2]; how many.

    `found` [M, 7]: first number of both Gaussians, second number, the Gaussians (one for _COLOURS), kind.
    Lists at most M. Steps of up to two cells are small by chance.
    """
    groups, count = geometry.shape[2] + 3 * (sh.shape[1] > 1), 0
    x, y = np.full((groups, _LANES), _NAN, np.uint32), np.zeros((groups, _LANES), np.uint32)
    known = np.empty((3, groups, _LANES), np.uint32)
    steps, cells = np.empty((groups, _LANES), np.float32), np.empty((groups, _LANES), np.float32)
    for pair in range(len(pairs)):
        one, other = pairs[pair]
        _read(geometry, sh, one, x)
        _read_other(geometry, sh, other, x, y)
        _compare(x, y, depth, known, steps, cells)
        for group in range(groups):
            for at in range(_LANES):
                for each in range(at):
                    cell, step = max(cells[group, at], cells[group, each]), steps[group, at]
                    if abs(step - steps[group, each]) <= cell and step > 2 * cell:
                        if count == len(found):
                            return count
                        row = found[count]
                        row[0], row[1] = x[group, at], y[group, at]
                        row[2], row[3] = x[group, each], y[group, each]
                        row[4], row[5], row[6] = one, max(one, other), _GEOMETRY
                        if group >= geometry.shape[2]:
                            row[6] = _HARMONICS if other >= 0 else _BETWEEN_COLOURS
                        count += 1
    return count
