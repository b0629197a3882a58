"""One number about a file, with its standard error and its p-value."""

from __future__ import annotations

import math
from dataclasses import dataclass

from scipy.special import bdtrc, chdtrc, ndtr, pdtrc


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
    """A number that is normal around `expected` under the null; two-sided."""
    return Statistic(value, error, float(2 * ndtr(-abs(value - expected) / error)))


def excess(hits: int, trials: int, expected: float) -> Statistic:
    """`hits` over their expected number, with the exact binomial probability of at least as many."""
    if trials == 0:
        return NOTHING
    p = float(bdtrc(hits - 1, trials, expected)) if hits else 1.0
    mean = trials * expected
    return Statistic(hits / mean, math.sqrt(max(hits, mean, 1.0)) / mean, p)


def portion(hits: float, trials: int) -> Statistic:
    """A share without a null of its own."""
    return Statistic(hits / max(trials, 1), math.sqrt(max(hits, 1.0)) / max(trials, 1))


def more_than_smooth(hits: int, expected: float, of: int) -> Statistic:
    """`hits` beyond those of a smooth density, as a share, with the Poisson probability."""
    error = math.sqrt(max(hits, expected, 1.0)) / max(of, 1)
    return Statistic((hits - expected) / max(of, 1), error, float(pdtrc(hits - 1, expected)) if hits else 1.0)


def dispersion(chi_square: float, degrees: int) -> Statistic:
    """Chi-square per degree of freedom less 1: above 0 is more uneven than random."""
    if degrees < 10:
        return NOTHING
    return Statistic(chi_square / degrees - 1, math.sqrt(2 / degrees), float(chdtrc(degrees, chi_square)))
