"""Equal steps: harmonics that predict each other's low bits.

Adam's steps do not depend on the size of a gradient. While one of two siblings, Gaussians that density
control split, is seen alone, or both in one direction, all harmonics of a colour move apart by the same
amount. The same holds for the distance from zero, where harmonics start, and for scales and for quaternions.
Constant colours, which are never written, move by the same amount times the ratio of two learning rates.
While two colours of a Gaussian are wrong by the same factor, the harmonics of both move together.

A Gaussian is left alone if three numbers of a group (the harmonics of a colour, a quaternion, or scales and
opacity) moved by equal amounts away from zero, from another of its colours or from one of its nearest
neighbours, up to the precision of the bits that stay. Halves of a large Gaussian may be far apart: they are
found by sums and differences of three numbers, which equal steps leave alone. No rate of a trainer is
assumed. By chance two agree in many Gaussians; whether these predict low bits is tested on each model, at
each depth.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from keyss.channels.lsb.bits import LEAST, LOW, Layout, bit_patterns
from keyss.core.arrays import Flags, Integers, Words32, doubles
from keyss.core.gaussians import Gaussians
from keyss.core.neighbours import Neighbours, nearest_neighbours
from keyss.files.formats.common import morton_order
from keyss.kernels.jit import inline, kernel
from keyss.kernels.parallel import in_blocks

_NEIGHBOURS = 12  # siblings were among the nearest 10 in models of 20,000 to 200,000 Gaussians
_EQUAL = 3  # numbers
_ALIKE = 2  # nearest in each of the sums and differences
_MANY_EQUAL = 5  # harmonics, or all, of Gaussians that were found by three
_ROWS = 1 << 11  # that a thread takes at a time
_SAMPLE = 8000  # Gaussians whose pairs of numbers are tested
_DRAWS = 16
_PARTS = np.array([[1 / 16], [1 / 8], [1 / 4]])  # of a cell
_ZERO, _COLOURS = -1, -2  # what a Gaussian is compared with, before its neighbours
_GEOMETRY, _HARMONICS, _BETWEEN_COLOURS = _KINDS = 0, 1, 2
_LANES = 16  # of a group: as many as a processor compares at once
_NAN, _EXPONENT, _MAGNITUDE = np.uint32(0x7FC00000), np.uint32(0x7F800000), np.uint32(0x7FFFFFFF)


class Steps:
    """The numbers of a model, and the nearest neighbours of its Gaussians.

    A *cell* is the range of a number's low bits at a depth.
    """

    def __init__(self, gaussians: Gaussians, layout: Layout) -> None:
        means = np.nan_to_num(doubles(gaussians.means), posinf=0, neginf=0)
        self.order = morton_order(means.astype(np.float32))  # what neighbours share stays in the cache
        self.near = np.empty((len(means), min(_NEIGHBOURS, max(0, len(means) - 1))), np.int32)
        self.words = _words(gaussians, layout)
        if self.near.size:
            tree = Neighbours(means, self.near.shape[1] + 1)

            def search(start: int, stop: int) -> None:
                rows = self.order[start:stop]
                self.near[rows] = tree.of(means[rows])[1][:, 1:]

            in_blocks(search, len(means), _ROWS)
        self.alike = _alike(*self.words)

    def equal(self, depth: int, among: Flags | None = None) -> Flags:
        """Mask [N] of Gaussians that moved by equal amounts, by the bits that stay at a depth.

        `among` [N]: those that did at a larger depth, where steps are less exact.
        """
        rows = self.order if among is None else self.order[among[self.order]]
        apart = np.zeros(len(self.order), bool)

        def mark(start: int, stop: int) -> None:
            own = rows[start:stop]
            _mark(own, self.near, *self.words, depth, _COLOURS, _EQUAL, apart)
            _mark(own, self.alike, *self.words, depth, 0, _MANY_EQUAL, apart)

        in_blocks(mark, len(rows), _ROWS, _mark)
        return apart

    def chance(self, depth: int, usable: Flags) -> float:
        """p-value of low bits that follow from each other, for new low bits of the `usable` [N] Gaussians.

        Compares the number of equal differences of two numbers with those after new draws of the low bits:
        one-sided Poisson tests, Bonferroni-corrected.
        """
        from scipy.special import pdtrc  # takes long to load

        rows, random, chances = self.order[usable[self.order]], np.random.default_rng(0), [1.0]
        rows = rows[:: max(1, len(rows) // _SAMPLE)]
        found, count = np.empty((0, 7), np.uint32), 0
        while count == len(found):
            found = np.empty((2 * len(found) + len(rows) + 1, 7), np.uint32)
            count = _pairs(rows, self.near, *self.words, depth, found)
        for kind in _KINDS:
            own = found[:count][found[:count, 6] == kind]
            words, pairs = own[:, :4], own[:, 4:6]
            written = usable[np.tile(pairs, 2)]
            hits, drawn = _hits(words, depth), np.zeros(len(_PARTS))
            for _ in range(_DRAWS):
                drawn += _hits(redrawn(words, written, depth, random), depth)
            chances += pdtrc(hits - 1.0, np.maximum(drawn, 1) / _DRAWS)[hits > 0].tolist()
        return min(1.0, min(chances) * len(_KINDS) * len(_PARTS))


def moved_from_zero(gaussians: Gaussians, layout: Layout) -> Flags:
    """Mask [N] of Gaussians whose numbers moved by equal amounts away from zero, at the least depth."""
    apart, none = np.zeros(len(gaussians), bool), np.empty((len(gaussians), 0), np.int32)
    _mark(np.arange(len(apart)), none, *_words(gaussians, layout), LEAST, _ZERO, _EQUAL, apart)
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


def _alike(geometry: Words32, sh: Words32) -> Integers:
    """[N, 4 _ALIKE] Gaussians with nearly equal sums or differences of three numbers, for all signs of steps.

    The numbers are the mean harmonics of degree 1 or, at SH degree 0, the log scales.
    """
    numbers = (sh[:, 1:4] if sh.shape[1] > 1 else geometry[:, :3, :1]) & ~LOW
    means = np.nan_to_num(numbers.view(np.float32).astype(np.float64), posinf=0, neginf=0).mean(axis=2)
    kept = [means[:, :1] - means[:, 1:] * signs for signs in ((1, 1), (1, -1), (-1, 1), (-1, -1))]
    count = min(_ALIKE, max(0, len(means) - 1))

    def search(index: int, _: int) -> Integers:
        flat = np.pad(kept[index], ((0, 0), (0, 1))).astype(np.float32)
        order = morton_order(flat)  # what neighbours share stays in the cache
        found = np.empty((len(order), count), np.int64)
        found[order] = order[nearest_neighbours(kept[index][order], count + 1)[1][:, 1:]]
        return found

    near = [np.empty((len(means), 0), np.int64)]
    if count:
        near += in_blocks(search, len(kept), 1)
    alike: Integers = np.concatenate(near, axis=1)
    return alike


def _hits(words: Words32, depth: int) -> Integers:
    """Counts of rows (a, b, c, d) of `words` [M, 4] in which b - a and d - c agree up to _PARTS of a cell."""
    numbers = words.view(np.float32).astype(np.float64)
    steps = abs(numbers[:, 1::2] - numbers[:, ::2])
    cells = (words & _EXPONENT).view(np.float32).max(axis=1) * 2.0 ** (depth + 1 - 23)
    counts: Integers = (abs(steps[:, 1] - steps[:, 0]) < _PARTS * cells).sum(axis=1)
    return counts


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
def _rotate(x: Any, y: Any, quats: Any) -> None:
    """Set `y` [groups, _LANES] to the next colours of x, with its signs; geometry is equal to nothing."""
    for group in range(len(x)):
        source = quats + (group - quats + 1) % 3
        for at in range(_LANES):
            y[group, at] = _NAN
            if group >= quats:
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


@kernel
def _mark(
    rows: Any, near: Any, geometry: Any, sh: Any, depth: int, first: int, least: int, apart: Any
) -> None:
    """Set `apart` [N] for pairs of a row and one of its neighbours in `near` [N, K].

    `least`: equal steps of harmonics. `first`: what comes before neighbours, _COLOURS and _ZERO, _ZERO, or 0
    for neither.
    """
    groups = geometry.shape[2] + 3 * (sh.shape[1] > 1)
    x = np.full((groups, _LANES), _NAN, np.uint32)  # unused lanes are equal to nothing
    y, known = np.zeros((groups, _LANES), np.uint32), np.empty((3, groups, _LANES), np.uint32)
    steps, cells = np.empty((groups, _LANES), np.float32), np.empty((groups, _LANES), np.float32)
    for one in rows:
        _read(geometry, sh, one, x)
        for place in range(first, near.shape[1]):
            other = one if place < 0 else near[one, place]
            if (apart[one] and apart[other]) or (place >= 0 and other == one):
                continue
            seen = False  # a pair of mutual neighbours is judged once
            for each in range(near.shape[1] if other < one else 0):
                seen |= near[other, each] == one
            if seen:
                continue
            if place >= 0:
                _read(geometry, sh, other, y)
            elif place == _ZERO:
                y[:] = 0
            else:
                _rotate(x, y, geometry.shape[2])
            _compare(x, y, depth, known, steps, cells)
            for group in range(groups):
                most = np.int32(0)
                for at in range(_LANES):
                    agree = np.int32(0)
                    for each in range(_LANES):
                        cell = max(cells[group, at], cells[group, each])
                        agree += np.int32(abs(steps[group, at] - steps[group, each]) <= cell)
                    most = max(most, agree)
                enough = _EQUAL if group < geometry.shape[2] else min(least, sh.shape[1] - 1)
                if most >= enough:
                    apart[one] = apart[other] = True
                    break


@kernel
def _pairs(rows: Any, near: Any, geometry: Any, sh: Any, depth: int, found: Any) -> int:
    """List pairs of numbers that differ by equal steps between `rows` and their neighbours; how many.

    The next colour counts as a neighbour. `found` [M, 7]: first number of row and neighbour, second number,
    row and neighbour, kind. Lists at most M. Steps of up to two cells are small by chance.
    """
    groups, count = geometry.shape[2] + 3 * (sh.shape[1] > 1), 0
    x, y = np.full((groups, _LANES), _NAN, np.uint32), np.zeros((groups, _LANES), np.uint32)
    known = np.empty((3, groups, _LANES), np.uint32)
    steps, cells = np.empty((groups, _LANES), np.float32), np.empty((groups, _LANES), np.float32)
    for one in rows:
        _read(geometry, sh, one, x)
        for place in range(-1, near.shape[1]):
            other = one if place < 0 else near[one, place]
            if place < 0:
                _rotate(x, y, geometry.shape[2])
            elif other <= one:  # each pair counts once
                continue
            else:
                _read(geometry, sh, other, y)
            _compare(x, y, depth, known, steps, cells)
            for group in range(groups):
                for at in range(_LANES):
                    for each in range(at):
                        cell = max(cells[group, at], cells[group, each])
                        step = steps[group, at]
                        if abs(step - steps[group, each]) <= cell and step > 2 * cell:
                            if count == len(found):
                                return count
                            row = found[count]
                            row[0], row[1] = x[group, at], y[group, at]
                            row[2], row[3] = x[group, each], y[group, each]
                            row[4], row[5], row[6] = one, other, _GEOMETRY
                            if group >= geometry.shape[2]:
                                row[6] = _HARMONICS if place >= 0 else _BETWEEN_COLOURS
                            count += 1
    return count
