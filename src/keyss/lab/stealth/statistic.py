"""Bit patterns of a model, and statistics of detectors with standard errors and p-values."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import bdtrc, chdtrc, ndtr, pdtrc

from keyss.channels.lsb.bits import bit_patterns
from keyss.core.arrays import Flags, Integers, Numbers, Words32
from keyss.core.gaussians import Gaussians

ATTRIBUTES = ("position", "scale", "rotation", "opacity", "colour", "sh1", "sh2", "sh3")
MANTISSA = 23
# Ranges of binary exponents. Training rounds a number on the grid of its largest value: small ones reveal
# most.
MAGNITUDES = {"tiny": (-126, -15), "small": (-15, -13), "middling": (-13, -9), "large": (-9, 128)}
# A number that ends in this many zeros was not trained; embedding does not change it.
_SHORT = np.uint32((1 << 20) - 1)


@dataclass(frozen=True)
class BitPatterns:
    """The F floats of each of N Gaussians, as bit patterns."""

    bits: Words32  # [N, F]
    attribute: Integers  # [F] index into ATTRIBUTES

    @staticmethod
    def of(model: Gaussians) -> BitPatterns:
        fields = [model.means, model.log_scales, model.quats, model.opacity_logits[:, None]]
        fields += [model.sh[:, band**2 : (band + 1) ** 2] for band in range(model.sh_degree + 1)]
        parts = [bit_patterns(field.contiguous()) for field in fields]
        attribute = np.repeat(np.arange(len(parts)), [part.shape[1] for part in parts])
        return BitPatterns(np.concatenate(parts, axis=1), attribute)

    @cached_property
    def exponent(self) -> Integers:
        """[N, F] binary exponents, -127 for zero."""
        return (self.bits >> MANTISSA & 255).astype(np.int64) - 127

    @cached_property
    def trained(self) -> Flags:
        """[N, F] True for numbers that are not short: see _SHORT."""
        result: Flags = (self.bits & _SHORT) != 0
        return result

    def of_attribute(self, index: int) -> slice:
        """The columns of an attribute."""
        columns = np.flatnonzero(self.attribute == index)
        return slice(int(columns[0]), int(columns[-1]) + 1) if len(columns) else slice(0, 0)


def ulps(one: Words32, other: Words32) -> Integers:
    """Distance of numbers in units in the last place; 2^31 if their signs differ."""
    a, b = (words & 0x7FFFFFFF for words in (one, other))
    distance = np.abs(a.astype(np.int64) - b.astype(np.int64))
    return np.where((one ^ other) >> 31 == 0, distance, np.int64(1) << 31)


@dataclass(frozen=True)
class Statistic:
    """The value of a detector on one file.

    `error`: the standard error of sampling, if known; control models may vary by more. `p`: the probability
    of at least this value under an exact null, if there is one.
    """

    value: float  # NaN if there is too little data
    error: float | None = None
    p: float | None = None


NOTHING = Statistic(math.nan)


def share(hits: float, trials: float, expected: float = 0.5) -> Statistic:
    """`hits` of `trials` against the expected share; two-sided, by the normal approximation."""
    if trials < 50:
        return NOTHING
    return normal(hits / trials, math.sqrt(expected * (1 - expected) / trials), expected)


def normal(value: float, error: float, expected: float = 0.0) -> Statistic:
    """A value that is normal around `expected` under the null; two-sided."""
    return Statistic(value, error, float(2 * ndtr(-abs(value - expected) / error)))


def excess(hits: int, trials: int, expected: float) -> Statistic:
    """`hits` / expected hits, with the exact binomial tail probability."""
    if trials == 0:
        return NOTHING
    p = float(bdtrc(hits - 1, trials, expected)) if hits else 1.0
    mean = trials * expected
    return Statistic(hits / mean, math.sqrt(max(hits, mean, 1.0)) / mean, p)


def portion(hits: Numbers, trials: Numbers | int = 1) -> Statistic:
    """The share of `hits` [G] in `trials` [G], without a null hypothesis.

    Its error, at least that of one hit, comes from the differences between G groups: the numbers of a
    Gaussian are hits together, for example of a copy.
    """
    total = float(np.broadcast_to(trials, hits.shape).sum())
    if total == 0:
        return NOTHING
    value = float(hits.sum()) / total
    return Statistic(value, math.sqrt(max(float(np.square(hits - value * trials).sum()), 1.0)) / total)


def near_misses(distance: Numbers, equal: Flags, moved: float, around: float) -> Statistic:
    """Unequal pairs closer than `moved`, in excess of a smooth density, as a share, with the Poisson tail.

    The density comes from the pairs whose distance is `moved` to `around`.
    """
    count = max(len(distance), 1)
    hits = int((~equal & (distance < moved)).sum())
    outside = int(((distance >= moved) & (distance < around)).sum())
    expected = max(outside, 1) * moved / (around - moved)
    error = math.sqrt(max(hits, expected, 1.0)) / count
    return Statistic((hits - expected) / count, error, float(pdtrc(hits - 1, expected)) if hits else 1.0)


def dispersion(chi_square: float, degrees: int) -> Statistic:
    """Chi-square per degree of freedom - 1: above 0 is more uneven than random."""
    if degrees < 10:
        return NOTHING
    return Statistic(chi_square / degrees - 1, math.sqrt(2 / degrees), float(chdtrc(degrees, chi_square)))
