"""Predictability of the low bits of small numbers, estimated from the model itself.

An optimiser that rounds its step before subtracting it leaves numbers on the grid of the larger ones that
they came from: a number that the last step brought near zero has as many trailing zeros as it is smaller than
that step. Steps are about exponentially distributed, because Adam bounds them: with the scale 2^(s + 1) of a
group of fields, a number of binary exponent e has at least z zeros forced upon it with the probability

    F(z) = exp(-2^(e + z - 1 - s)), z >= 1

Beside it the last bit alone is forced to zero with the probability min(1, t 2^-e), by rounding to even. Bits
above those forced are uniform. Hence only the number of trailing zeros carries information, and odd numbers
carry none. Both were measured on models that were trained with either rounding.

The counts of trailing zeros give an upper confidence limit of s, which bounds how well an attacker who knows
the trainer and the last bit predicts the replaced bits: the chi-square distance of the original bits from
uniform ones. Numbers below a least exponent are excluded to keep this distance small.
"""

from __future__ import annotations

import numpy as np

from keyss.core.arrays import Doubles, Flags, Integers, Words32

MAX_ZEROS = 12  # counted at most; numbers with more are rare, or short
EXPONENTS = 256
_NUMBERS = np.arange(1 << MAX_ZEROS, dtype=np.uint32)[:, None] | np.uint32(1 << MAX_ZEROS)
_ZEROS = (
    (_NUMBERS >> np.arange(MAX_ZEROS + 1, dtype=np.uint32) & 1).argmax(axis=1).astype(np.uint32)
)  # [4096], trailing
# Drop of the log-likelihood at the confidence limit: one-sided, one in 200.
_DROP = 3.3
_MARGIN = 8  # octaves beyond the numbers' exponents in the search for s
_STEP = 0.25  # octaves, resolution of the search
_LARGEST = 4  # octaves of the scale below the median number: steps of a sixteenth would never converge
_ROUNDED = np.concatenate([[0.0], 2.0 ** np.arange(-20, 20.5, 0.5)])  # t in units of the smallest exponent


def count_trailing_zeros(words: Words32, chosen: Flags) -> Integers:
    """[EXPONENTS, MAX_ZEROS + 1] counts of numbers by exponent and trailing zeros.

    `words` [N, C]; `chosen` [N]: mask of the rows to count.
    """
    own = words[chosen].ravel()
    kinds = (own >> np.uint32(23) & np.uint32(255)) * np.uint32(MAX_ZEROS + 1) + _ZEROS[own & np.uint32(4095)]
    return np.bincount(kinds, minlength=EXPONENTS * (MAX_ZEROS + 1)).reshape(EXPONENTS, -1)


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


def _confidence_limit(counts: Doubles, exponents: Integers) -> float:
    """The upper confidence limit of s for counts [E, MAX_ZEROS + 1] by `exponents` [E].

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


def _forced(exponents: Integers, scale: float) -> Doubles:
    """[E, MAX_ZEROS + 1] F(z): the probability that z zeros or more are forced."""
    zeros = np.arange(MAX_ZEROS + 1)
    steps = exponents[:, None] + zeros - 1.0 - scale
    forced: Doubles = np.exp(-(2.0 ** steps.clip(-60, 10)))
    forced[:, 0] = 1
    return forced


def _zeros(forced: Doubles) -> Doubles:
    """[E, MAX_ZEROS + 1] probabilities of z trailing zeros given F(z); the last: MAX_ZEROS or more."""
    exactly = forced - np.append(forced[:, 1:], np.zeros((len(forced), 1)), axis=1)
    at_least = np.zeros_like(forced)
    at_least[:, 0] = 1
    below = np.zeros(len(forced))  # probability of fewer than z forced zeros but z by chance
    for z in range(1, forced.shape[1]):
        below = (below + exactly[:, z - 1]) / 2
        at_least[:, z] = below + forced[:, z]
    return at_least - np.append(at_least[:, 1:], np.zeros((len(forced), 1)), axis=1)


def _log_likelihood(counts: Doubles, exponents: Integers, scale: float) -> float:
    """The log-likelihood of counts [E, MAX_ZEROS + 1], with the best probability of rounding to even."""
    chances = _zeros(_forced(exponents, scale)).clip(1e-12)
    even = 1 - chances[:, 0]
    inside = float((counts[:, 1:] * np.log(chances[:, 1:] / even[:, None])).sum())
    rounded = (_ROUNDED[:, None] * 2.0 ** -(exponents - exponents[0]).astype(np.float64)).clip(0, 1)
    odd = (chances[:, 0] * (1 - rounded)).clip(1e-12)  # [t, E]
    numbers, ones = counts.sum(axis=1), counts[:, 0]
    outside = (ones * np.log(odd) + (numbers - ones) * np.log((1 - odd).clip(1e-12))).sum(axis=1)
    return inside + float(outside.max())


def _distance(exponents: Integers, scale: float) -> Doubles:
    """[E] chi-square distance from uniform of the bits above the last one, of even numbers."""
    chances = _zeros(_forced(exponents, scale))[:, 1:]
    given = chances / chances.sum(axis=1, keepdims=True)
    uniform = 0.5 ** np.arange(1, MAX_ZEROS + 1)
    uniform[-1] *= 2
    result: Doubles = ((given - uniform) ** 2 / uniform).sum(axis=1)
    return result
