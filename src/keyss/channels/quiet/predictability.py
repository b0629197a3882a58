"""Low bits that an attacker predicts from other bits of the model: of small numbers, and of siblings.

*Small numbers*: an optimiser that rounds its step before subtracting it leaves numbers on the grid of the
larger ones that they came from: a number that the last step brought near zero has as many trailing zeros as
it is smaller than that step. Steps are about exponentially distributed, because Adam bounds them: with the
scale 2^(s + 1) of a group of fields, a number of binary exponent e has at least z zeros forced upon it with
the probability

    F(z) = exp(-2^(e + z - 1 - s)), z >= 1

Beside it the last bit alone is forced to zero with the probability min(1, t 2^-e), by rounding to even. Bits
above those forced are uniform. Hence only the number of trailing zeros carries information, and odd numbers
carry none. Both were measured on models that were trained with either rounding.

The counts of trailing zeros give an upper confidence limit of s, which bounds how well an attacker who knows
the trainer and the last bit predicts the replaced bits: the chi-square distance of the original bits from
uniform ones. Numbers below a least exponent are excluded to keep this distance small.

*Siblings* are Gaussians that density control split, whose constant colours predict low bits of harmonics.
Adam's steps do not depend on the size of a gradient. While one of two siblings is seen alone, or both in one
direction, all harmonics x of a colour move apart by the same amount, and its constant colour c, whose rate is
20 times as large in common trainers, by 20 times as much:

    |x(i) - x(j)| = |c(i) - c(j)| / 20

to a few units in the last place. Constant colours are never written. Siblings are near neighbours; where they
moved in few directions, a part of their harmonics agrees. By chance two or three harmonics of a pair do.

Where all views of a Gaussian have nearly one direction, as those of a far background, the gradients of some
harmonics keep their ratio throughout: of those of equal order m, if the direction is the axis z. Then two or
three of a colour move by equal steps in most Gaussians, too few to tell which ones: such a cover is refused.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from keyss.channels.quiet.bits import SH_BITS, UNUSED_BITS
from keyss.core.arrays import Doubles, Flags, Floats, Integers, Words32, doubles
from keyss.core.gaussians import Gaussians
from keyss.core.neighbours import Neighbours, nearest_neighbours
from keyss.files.formats.common import morton_order
from keyss.kernels.jit import kernel
from keyss.kernels.parallel import in_blocks

_MAX_ZEROS = 12  # counted at most; numbers with more are rare, or short
_EXPONENTS = 256
_NUMBERS = np.arange(1 << _MAX_ZEROS, dtype=np.uint32)[:, None] | np.uint32(1 << _MAX_ZEROS)
_ZEROS = (
    (_NUMBERS >> np.arange(_MAX_ZEROS + 1, dtype=np.uint32) & 1).argmax(axis=1).astype(np.uint32)
)  # [4096], trailing
# Drop of the log-likelihood at the confidence limit: one-sided, one in 200.
_DROP = 3.3
_MARGIN = 8  # octaves beyond the numbers' exponents in the search for s
_STEP = 0.25  # octaves, resolution of the search
_LARGEST = 4  # octaves of the scale below the median number: steps of a sixteenth would never converge
_ROUNDED = np.concatenate([[0.0], 2.0 ** np.arange(-20, 20.5, 0.5)])  # t in units of the smallest exponent
_RATE_RATIO = 20  # learning rate of constant colours / harmonics
_NEIGHBOURS = 12  # siblings were among the nearest 10 in models of 20,000 to 200,000 Gaussians
_SHARE = 3  # a third of the harmonics of a colour agree, and at least three
_ROWS = 1 << 12
_SAMPLE, _NEAR = 5000, 8  # Gaussians whose pairs of harmonics are tested, and neighbours of each
_COMPACT, _RUN = 100_000, 2000  # Gaussians that are looked at in larger models, in runs along a Z-order curve
# A span is the width of the interval of numbers with equal fixed bits; in its sixteenths, steps are equal.
_LOW, _PART = np.uint32((1 << SH_BITS + UNUSED_BITS) - 1), 16
_SPAN_SHARE = np.float32(2.0 ** (SH_BITS + UNUSED_BITS - 23))  # span / number, up to a factor of 2


def count_trailing_zeros(words: Words32, chosen: Flags) -> Integers:
    """[_EXPONENTS, _MAX_ZEROS + 1] counts of numbers by exponent and trailing zeros.

    `words` [N, C]; `chosen` [N]: mask of the rows to count.
    """
    own = words[chosen].ravel()
    kinds = (own >> np.uint32(23) & np.uint32(255)) * np.uint32(_MAX_ZEROS + 1) + _ZEROS[
        own & np.uint32(4095)
    ]
    return np.bincount(kinds, minlength=_EXPONENTS * (_MAX_ZEROS + 1)).reshape(_EXPONENTS, -1)


def least_exponent(counts: Integers, share: float) -> int:
    """The least exponent e such that even numbers of exponents from e on give away at most `share`.

    `counts`: the result of `count_trailing_zeros`. `share`: maximum squared separation (d') of the plain file
    and the file with new bits.
    """
    present = np.flatnonzero(counts.sum(axis=1))
    if not len(present):
        return 0
    known = counts[present].astype(np.float64)
    limit = _confidence_limit(known, present)
    even = known.sum(axis=1) - known[:, 0]
    given_away = even * _distance(present, limit)
    enough = np.flatnonzero(given_away[::-1].cumsum()[::-1] <= share)
    return int(present[enough[0]]) if len(enough) else int(present[-1]) + 1


def find_siblings(gaussians: Gaussians, among: Flags) -> Flags:
    """Mask [N] of Gaussians `among` [N] that moved away from a neighbour by equal steps, by fixed bits."""
    if len(gaussians) < 2 or not gaussians.sh_degree:
        return np.zeros(len(gaussians), bool)
    means = np.nan_to_num(doubles(gaussians.means), posinf=0, neginf=0)
    order = morton_order(means.astype(np.float32))  # neighbours are near in memory, too
    means, rows = means[order], np.flatnonzero(among[order])
    neighbours = Neighbours(means, min(_NEIGHBOURS + 1, len(means)))
    numbers = gaussians.sh.detach().to("cpu", torch.float32).numpy()
    middles = np.empty((len(means), 3, numbers.shape[1]), np.float32)

    def gather(start: int, stop: int) -> None:
        sh = numbers[order[start:stop]].transpose(0, 2, 1)
        middles[start:stop] = _middles(sh)
        middles[start:stop, :, 0] = sh[:, :, 0] / np.float32(_RATE_RATIO)

    in_blocks(gather, len(means), _ROWS)
    needed = 1 + max(_SHARE, -(-(middles.shape[2] - 1) // _SHARE))
    apart = np.zeros(len(means), bool)

    def mark(start: int, stop: int) -> None:
        some = rows[start:stop]
        _mark(some, neighbours.of(means[some])[1], middles, needed, apart)

    in_blocks(mark, len(rows), _ROWS)
    siblings = np.zeros(len(means), bool)
    siblings[order] = apart
    return siblings & among


def chance_of_equal_steps(gaussians: Gaussians, usable: Flags) -> float:
    """p-value of equal steps of two harmonics under the null hypothesis of uniform low bits of `usable` [N].

    Of differences between neighbours that agree as far as fixed bits tell, as many are below a sixteenth of a
    span as between one and two sixteenths. Exact binomial tests, Bonferroni-corrected.
    """
    from scipy.special import bdtr  # takes long to load

    rows = np.flatnonzero(usable)
    if len(rows) < 2 or not gaussians.sh_degree:
        return 1.0
    means = np.nan_to_num(doubles(gaussians.means), posinf=0, neginf=0)[rows]
    if len(rows) > 2 * _COMPACT:  # parts of the space with all their Gaussians, as neighbours are needed
        order = morton_order(means.astype(np.float32))
        kept = np.concatenate([part[:_RUN] for part in np.array_split(order, _COMPACT // _RUN)])
        rows, means = rows[kept], means[kept]
    sample = np.arange(0, len(rows), -(-len(rows) // _SAMPLE))
    near = nearest_neighbours(means[sample], min(_NEAR + 1, len(rows)), means)[1]
    sh = gaussians.sh.detach().to("cpu", torch.float32).numpy()[rows]
    counts = np.zeros((2, sh.shape[1], sh.shape[1]), np.int64)
    _count_equal(sample, near, sh, _middles(sh), counts)
    equal, other = counts[:, counts.any(axis=0)]
    chances = bdtr(other.astype(np.float64), equal + other, 0.5)
    return min(1.0, float(chances.min(initial=1.0)) * len(chances))


def _confidence_limit(counts: Doubles, exponents: Integers) -> float:
    """The upper confidence limit of s for counts [E, _MAX_ZEROS + 1] by `exponents` [E].

    If there are too few small numbers for an estimate, the largest plausible s.
    """
    scales = np.arange(exponents[0] - _MARGIN, exponents[-1] + _MARGIN + 1, _STEP)
    likelihoods = np.array([_log_likelihood(counts, exponents, scale) for scale in scales])
    likely = likelihoods >= likelihoods.max() - _DROP
    limit = float(scales[likely][-1])
    if not likely[0]:  # the lower end of the range is excluded
        return limit
    numbers = counts.sum(axis=1).cumsum()
    return min(limit, float(exponents[np.searchsorted(numbers, numbers[-1] / 2)]) - _LARGEST)


def _zeros(exponents: Integers, scale: float) -> Doubles:
    """[E, _MAX_ZEROS + 1] probabilities of z trailing zeros; the last: _MAX_ZEROS or more."""
    steps = exponents[:, None] + np.arange(_MAX_ZEROS + 1) - 1.0 - scale
    forced = np.exp(-(2.0 ** steps.clip(-60, 10)))  # F(z)
    forced[:, 0] = 1
    exactly = -np.diff(forced, append=0)
    at_least = np.ones_like(forced)
    below = np.zeros(len(forced))  # probability of fewer than z forced zeros but z by chance
    for z in range(1, forced.shape[1]):
        below = (below + exactly[:, z - 1]) / 2
        at_least[:, z] = below + forced[:, z]
    return -np.diff(at_least, append=0)


def _log_likelihood(counts: Doubles, exponents: Integers, scale: float) -> float:
    """The log-likelihood of counts [E, _MAX_ZEROS + 1], with the best probability of rounding to even."""
    chances = _zeros(exponents, scale).clip(1e-12)
    even = 1 - chances[:, 0]
    inside = float((counts[:, 1:] * np.log(chances[:, 1:] / even[:, None])).sum())
    rounded = (_ROUNDED[:, None] * 2.0 ** -(exponents - exponents[0]).astype(np.float64)).clip(0, 1)
    odd = (chances[:, 0] * (1 - rounded)).clip(1e-12)  # [t, E]
    numbers, ones = counts.sum(axis=1), counts[:, 0]
    outside = (ones * np.log(odd) + (numbers - ones) * np.log((1 - odd).clip(1e-12))).sum(axis=1)
    return inside + float(outside.max())


def _distance(exponents: Integers, scale: float) -> Doubles:
    """[E] chi-square distance from uniform of the bits above the last one, of even numbers."""
    chances = _zeros(exponents, scale)[:, 1:]
    given = chances / chances.sum(axis=1, keepdims=True)
    uniform = 0.5 ** np.arange(1, _MAX_ZEROS + 1)
    uniform[-1] *= 2
    result: Doubles = ((given - uniform) ** 2 / uniform).sum(axis=1)
    return result


def _middles(numbers: Floats) -> Floats:
    """[...] float32 numbers with the middle of all low bits, as far as fixed bits tell them."""
    return (numbers.view(np.uint32) & ~_LOW | (_LOW + 1) >> 1).view(np.float32)


@kernel
def _mark(rows: Any, near: Any, middles: Any, needed: int, apart: Any) -> None:
    """Set `apart` for both Gaussians of pairs of `rows` [R] and their neighbours `near` [R, K].

    `middles` [N, 3, C]: the first harmonic is the constant one, by the ratio of rates; it always agrees.
    """
    for row in range(len(rows)):
        one = rows[row]
        for other in near[row]:
            if other == one or (apart[one] and apart[other]):
                continue
            for colour in range(3):
                own, its = middles[one, colour], middles[other, colour]
                steps = abs(own[0] - its[0])
                agree = np.float32(0)
                for at in range(len(own)):
                    span = max(abs(own[at]), abs(its[at])) * _SPAN_SHARE
                    agree += np.float32(1 if abs(abs(own[at] - its[at]) - steps) <= span else 0)
                if agree >= needed:
                    apart[one] = apart[other] = True


@kernel
def _count_equal(rows: Any, near: Any, sh: Any, middles: Any, counts: Any) -> None:
    """Add to `counts` [2, C, C] pairs of harmonics whose steps from `rows` [R] to `near` [R, K] are equal.

    Then those whose steps differ by up to twice as much. `sh` [N, C, 3] and its `middles`.
    """
    size = sh.shape[1]
    steps, known, spans = np.empty(size), np.empty(size), np.empty(size)
    for row in range(len(rows)):
        for other in near[row]:
            for colour in range(3):
                for at in range(size):
                    steps[at] = abs(sh[rows[row], at, colour] - sh[other, at, colour])
                    own, its = middles[rows[row], at, colour], middles[other, at, colour]
                    known[at] = abs(own - its)
                    spans[at] = max(abs(own), abs(its)) * _SPAN_SHARE
                steps[0], known[0], spans[0] = steps[0] / _RATE_RATIO, steps[0] / _RATE_RATIO, 0.0
                for one in range(size):
                    for two in range(one + 1, size):
                        span = max(spans[one], spans[two])
                        if known[one] > 2 * span and abs(known[one] - known[two]) <= span < known[two] / 2:
                            off = abs(steps[one] - steps[two]) * _PART
                            if off < 2 * span:
                                counts[0 if off < span else 1, one, two] += 1
