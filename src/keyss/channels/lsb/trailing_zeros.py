"""Small numbers whose low bits an optimiser's rounding predicts.

An optimiser that rounds its step before subtracting it leaves numbers on the grid of the larger ones that
they came from: a number that the last step brought near zero has as many trailing zeros as it is smaller than
that step. Steps are about exponentially distributed, because Adam bounds them: with the scale 2^(s + 1) of a
group of fields, a number of binary exponent e has at least z zeros forced upon it with the probability

    F(z) = exp(-2^(e + z - 1 - s)), z >= 1

Beside it, rounding to even may force the last bit alone to zero. Bits above those forced are uniform. Hence
only the number of trailing zeros of even numbers carries information. Both were measured on models that were
trained with either rounding.

The counts of trailing zeros give an upper confidence limit of s, which bounds how well an attacker who knows
the trainer and the last bit predicts the replaced bits: the chi-square distance of the original bits from
uniform ones. Numbers below a least exponent are excluded to keep this distance small.
"""

from __future__ import annotations

import numpy as np

from keyss.core.arrays import Doubles, Integers, Words32

_MAX_ZEROS = 12  # maximum count; numbers with more zeros are rare, or short
_EXPONENTS = 256
_NUMBERS = np.arange(1 << _MAX_ZEROS, dtype=np.uint32)[:, None] | np.uint32(1 << _MAX_ZEROS)
_ZEROS = (_NUMBERS >> np.arange(_MAX_ZEROS + 1, dtype=np.uint32) & 1).argmax(axis=1).astype(np.uint32)
# Probabilities of 1 to 12 trailing zeros in random even numbers.
_UNIFORM = 0.5 ** np.append(np.arange(1, _MAX_ZEROS), _MAX_ZEROS - 1)
# Drop of the log-likelihood at the confidence limit: one-sided, one in 200.
_DROP = 3.3
_MARGIN, _STEP = 8, 0.25  # range beyond the numbers' exponents and resolution of the search for s; octaves
_LARGEST = 4  # octaves of the scale below the median number: steps of a sixteenth would never converge


def count_trailing_zeros(words: Words32) -> Integers:
    """[_EXPONENTS, _MAX_ZEROS + 1] counts of the numbers `words` [...] by exponent and trailing zeros."""
    exponents = words >> np.uint32(23) & np.uint32(255)
    kinds = exponents * np.uint32(_MAX_ZEROS + 1) + _ZEROS[words & np.uint32(len(_ZEROS) - 1)]
    return np.bincount(kinds.ravel(), minlength=_EXPONENTS * (_MAX_ZEROS + 1)).reshape(_EXPONENTS, -1)


def least_exponent(counts: Integers, share: float) -> int:
    """The least exponent e such that even numbers of exponents from e on leak at most `share`.

    `counts`: the result of `count_trailing_zeros`. `share`: maximum squared separation (d') of the plain file
    and the file with new bits.
    """
    present = np.flatnonzero(counts.sum(axis=1))
    if not len(present):
        return 0
    even = counts[present, 1:].astype(np.float64)
    scales = np.arange(present[0] - _MARGIN, present[-1] + _MARGIN + 1, _STEP)
    chances = np.stack([_chances(present, scale) for scale in scales])  # [S, E, _MAX_ZEROS]
    likelihoods = (even * np.log(chances)).sum(axis=(1, 2))
    likely = np.flatnonzero(likelihoods >= likelihoods.max() - _DROP)
    chosen = likely[-1]
    if likely[0] == 0:  # perhaps no zeros are forced, or there are too few numbers to tell
        numbers = counts[present].sum(axis=1).cumsum()
        most = present[np.searchsorted(numbers, numbers[-1] / 2)] - _LARGEST
        chosen = min(chosen, max(0, np.searchsorted(scales, most)))
    distances = ((chances[chosen] - _UNIFORM) ** 2 / _UNIFORM).sum(axis=1)
    given_away = (even.sum(axis=1) * distances)[::-1].cumsum()[::-1]
    enough = np.flatnonzero(given_away <= share)
    return int(present[enough[0]]) if len(enough) else int(present[-1]) + 1


def _chances(exponents: Integers, scale: float) -> Doubles:
    """[E, _MAX_ZEROS] probabilities of 1, 2, ... trailing zeros of even numbers; the last: or more."""
    steps = exponents[:, None] + np.arange(_MAX_ZEROS + 1) - 1.0 - scale
    forced = np.exp(-(2.0 ** steps.clip(-60, 10)))  # F(z)
    forced[:, 0] = 1
    exactly = -np.diff(forced, append=0)
    at_least = np.ones_like(forced)
    below = np.zeros(len(forced))  # probability of fewer than z forced zeros but z by chance
    for z in range(1, forced.shape[1]):
        below = (below + exactly[:, z - 1]) / 2
        at_least[:, z] = below + forced[:, z]
    chances: Doubles = (-np.diff(at_least[:, 1:], append=0)).clip(1e-12)
    shares: Doubles = chances / chances.sum(axis=1, keepdims=True)
    return shares
