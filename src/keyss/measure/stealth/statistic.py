"""One number about a file, with what it would be by chance."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from scipy.special import bdtrc, chdtrc, ndtr, pdtrc


@dataclass(frozen=True)
class Statistic:
    """What a detector counts in one file.

    `error`: standard error from sampling alone, where it is known; from training to training a statistic may
    vary by more, which only control models tell. `p`: probability of at least as much under an exact null,
    where there is one.
    """

    value: float  # NaN where there is too little to count
    error: float | None = None
    p: float | None = None


Statistics = Mapping[str, Statistic]
NOTHING = Statistic(math.nan)


def share(hits: float, trials: float, expected: float = 0.5) -> Statistic:
    """`hits` of `trials` against the share that chance gives; two-sided, by the normal approximation."""
    if trials < 50:
        return NOTHING
    return normal(hits / trials, math.sqrt(expected * (1 - expected) / trials), expected)


def normal(value: float, error: float, expected: float = 0.0) -> Statistic:
    """A number that by chance is normal around `expected`; two-sided."""
    return Statistic(value, error, float(2 * ndtr(-abs(value - expected) / error)))


def excess(hits: int, trials: int, expected: float) -> Statistic:
    """`hits` over those that chance gives, with the exact binomial probability of so many or more."""
    if trials == 0:
        return NOTHING
    p = float(bdtrc(hits - 1, trials, expected)) if hits else 1.0
    most = trials * expected
    return Statistic(hits / most, math.sqrt(max(hits, most, 1.0)) / most, p)


def portion(hits: float, trials: int) -> Statistic:
    """A share that has no null of its own."""
    return Statistic(hits / max(trials, 1), math.sqrt(max(hits, 1.0)) / max(trials, 1))


def more_than_smooth(hits: int, expected: float, of: int) -> Statistic:
    """`hits` beyond those of a smooth density, as a share, and the Poisson probability of so many."""
    error = math.sqrt(max(hits, expected, 1.0)) / max(of, 1)
    return Statistic((hits - expected) / max(of, 1), error, float(pdtrc(hits - 1, expected)) if hits else 1.0)


def dispersion(chi_square: float, degrees: int) -> Statistic:
    """Chi-square per degree of freedom less 1: above 0 is more uneven than chance."""
    if degrees < 10:
        return NOTHING
    return Statistic(chi_square / degrees - 1, math.sqrt(2 / degrees), float(chdtrc(degrees, chi_square)))


def named(prefix: str, found: Mapping[str, Statistic]) -> dict[str, Statistic]:
    return {f"{prefix}/{name}": each for name, each in found.items()}
