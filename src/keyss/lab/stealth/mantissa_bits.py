"""Mantissa bits that are not random, conditioned on everything else that an attacker sees.

Statistics by attribute, magnitude and position of the bit, and given the bit below. Numbers with a zero in
the last bit have zeros above it too after training, but not after embedding.
"""

from __future__ import annotations

import numpy as np

from keyss.core.arrays import Flags, Words32
from keyss.core.gaussians import Gaussians
from keyss.lab.stealth.statistic import (
    ATTRIBUTES,
    MAGNITUDES,
    MANTISSA,
    NOTHING,
    BitPatterns,
    Statistic,
    dispersion,
    normal,
    share,
)

RANGES = {"0": (0, 1), "1-3": (1, 4), "4-8": (4, 9), "9-12": (9, 13)}
_BITS = 14  # lowest bits of a number
_HARMONICS = ATTRIBUTES.index("sh1")
_MIN_COUNT = 64  # numbers of a stratum


def bits(model: Gaussians, words: BitPatterns) -> dict[str, Statistic]:
    """Statistics of single numbers by attribute and magnitude, with an exact null: fair, independent bits."""
    statistics: dict[str, Statistic] = {}
    for index, attribute in enumerate(ATTRIBUTES):
        columns = words.of_attribute(index)
        own = words.bits[:, columns][words.trained[:, columns]]
        if len(own):
            statistics |= {f"{name}, {attribute}": each for name, each in _of_values(own).items()}
            statistics[f"strata of {attribute}"] = _strata(own)
    harmonics = words.attribute >= _HARMONICS
    own, trained = words.bits[:, harmonics], words.trained[:, harmonics]
    exponent = words.exponent[:, harmonics]
    for magnitude, (low, high) in MAGNITUDES.items():
        values = own[trained & (exponent >= low) & (exponent < high)]
        statistics |= {f"{name}, {magnitude} harmonics": each for name, each in _of_values(values).items()}
    small = trained & (exponent < MAGNITUDES["middling"][1])
    statistics["zeros together in a Gaussian"] = _count_variance(own, small)
    tiny = (trained & (exponent < MAGNITUDES["tiny"][1])).any(axis=1)
    for name, rows in (("with", tiny), ("without", ~tiny)):
        found = _of_values(own[rows][trained[rows]])["ones in bits 1-3"]
        statistics[f"Gaussians with tiny harmonics, ones in bits 1-3 {name}"] = found
    return statistics


def _of_values(values: Words32) -> dict[str, Statistic]:
    """Shares of ones, of trailing zeros, and of zeros in bits 1 to 3 given bit 0."""
    statistics = {}
    for name, (low, high) in RANGES.items():
        ones = sum(int((values >> bit & 1).sum()) for bit in range(low, high))
        statistics[f"ones in bits {name}"] = share(ones, len(values) * (high - low))
    for count in (4, 8):
        zeros = int((values & np.uint32((1 << count) - 1) == 0).sum())
        statistics[f"{count} zeros at the end"] = share(
            zeros, len(values) if len(values) >> count > 5 else 0, 2.0**-count
        )
    even = values & 1 == 0
    clear = values & np.uint32(14) == 0
    statistics["zeros above a zero"] = _difference(clear[even], clear[~even], 1 / 8)
    return statistics


def _difference(one: Flags, other: Flags, expected: float) -> Statistic:
    """Difference of the shares in `one` and `other`, both `expected` under the null."""
    if min(len(one), len(other)) < _MIN_COUNT:
        return NOTHING
    error = (expected * (1 - expected) * (1 / len(one) + 1 / len(other))) ** 0.5
    return normal(float(one.mean() - other.mean()), error)


def _strata(values: Words32) -> Statistic:
    """Chi-square of the ones by exponent, position of the bit and the bit below."""
    total, degrees = 0.0, 0
    exponent = (values >> MANTISSA & 255).astype(np.int64)
    for bit in range(1, _BITS):
        stratum = exponent * 2 + (values >> (bit - 1) & 1)
        count = np.bincount(stratum)
        ones = np.bincount(stratum, weights=values >> bit & 1)
        enough = count >= _MIN_COUNT
        total += float(((ones - count / 2) ** 2 / np.maximum(count / 4, 1))[enough].sum())
        degrees += int(enough.sum())
    return dispersion(total, degrees)


def _count_variance(values: Words32, chosen: Flags) -> Statistic:
    """Variance over Gaussians of their count of small harmonics with zeros in bits 1 to 3."""
    zeros = ((values & np.uint32(14) == 0) & chosen).sum(axis=1)
    trials = chosen.sum(axis=1)
    rows = trials > 1
    if rows.sum() < _MIN_COUNT:
        return NOTHING
    z2 = (zeros[rows] - trials[rows] / 8) ** 2 / (trials[rows] * 7 / 64)
    # The kurtosis of a binomial number: 1 / variance - 6 / n beyond that of a normal one.
    variance = 2 + 1 / (trials[rows] * 7 / 64) - 6 / trials[rows]
    error = float(np.sqrt(variance.sum()) / rows.sum())
    return normal(float(z2.mean() - 1), error)
