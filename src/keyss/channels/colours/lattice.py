"""Bits in numbers: dithered quantisation index modulation (Chen and Wornell 2001), read softly.

A number that carries b bits is moved to the nearest point of one of 2^b lattices of step 2^b x SPACING. They
lie SPACING apart and are shifted together by a *dither*, a number that only the key tells and that no two
Gaussians share. So without the key the change is independent noise, uniform over one step, of variance
step^2 / 12, and no value is likelier than another.

The bits of a Gaussian follow from its *impact* and one *level* for all: one bit less for every factor of four
in how much a change of its colour shows, so that all that carry something cost equally much.
"""

from __future__ import annotations

import math

import numpy as np

from keyss.channels.colours.carriers import Carriers, Names, random_pairs, rank
from keyss.channels.mixing import mixed
from keyss.core.arrays import Bits, Doubles, Floats, Integers, Words

COLUMNS = 2  # numbers of a Gaussian that are written
MAX_BITS = 5  # of a number
SPACING = 0.0275  # between neighbouring points
LEVELS = 64
_BIT = math.log(4)  # of impact; a level is a quarter of a bit
_MIDDLE = 24  # level at which an impact of zero carries nothing any more
_NOISE = 0.23  # standard deviation of a format's rounding, in spacings
_POINTS = np.array([-1.0, 0.0, 1.0, 2.0])  # that a number may have come from, from the one below on


def bit_counts(carriers: Carriers, level: int, depth: int) -> Integers:
    """[C] bits of each of a carrier's numbers: at most `depth`, and more at a higher level (below LEVELS)."""
    bits = np.floor((level - _MIDDLE) / 4 - carriers.impact / _BIT)
    return bits.clip(0, depth).astype(np.int64)


def seeds(secret: bytes, label: str, names: Names, bits: Integers) -> Words:
    """[B] the seeds of all bits of Gaussians with these names, for `Fountain`; `bits` [C]: of each number."""
    counts = COLUMNS * bits
    order = np.arange(1, counts.sum() + 1) - np.repeat(np.cumsum(counts) - counts, counts)
    return mixed(np.repeat(rank(secret, label, names), counts) ^ mixed(order.astype(np.uint64)))


def write(secret: bytes, carriers: Carriers, bits: Integers, code: Bits) -> Doubles:
    """[C, 2] new values that carry the bits `code` [B], `bits` [C] in each number."""
    counts = np.repeat(bits, COLUMNS)
    label, first = np.zeros(len(counts), np.int64), np.cumsum(counts) - counts
    for bit in range(MAX_BITS):
        rows = np.flatnonzero(counts > bit)
        label[rows] = label[rows] << 1 | code[first[rows] + bit]
    step, values = SPACING * 2.0**counts, carriers.values.ravel()
    points = dithers(secret, carriers.names).ravel() * step + _ungray(label) * SPACING
    nearest = np.round((values - points) / step) * step + points
    return np.where(counts > 0, nearest, values).reshape(-1, COLUMNS)


def read(dither: Doubles, carriers: Carriers, bits: Integers, doubt: Doubles) -> Floats:
    """[B] logarithms of P(0) / P(1) of all bits; each number of a carrier has `bits` [C].

    `dither` [C, 2]: of `dithers`. `doubt` [C]: the chance that a carrier holds something else.
    """
    counts, doubts = np.repeat(bits, COLUMNS), np.repeat(doubt, COLUMNS)
    period = 1 << counts
    place = np.mod(carriers.values.ravel() / SPACING - dither.ravel() * period, period)[:, None]
    points = np.floor(place) + _POINTS
    weight = np.exp(-((place - points) ** 2) / (2 * _NOISE**2))
    weight /= weight.sum(axis=1, keepdims=True)
    label = points.astype(np.int64) % period[:, None]
    label ^= label >> 1
    ratios, ends = np.zeros(int(counts.sum()), np.float32), np.cumsum(counts)
    for bit in range(MAX_BITS):  # from the last one on
        rows = np.flatnonzero(counts > bit)
        ones = (weight[rows] * (label[rows] >> bit & 1)).sum(axis=1)
        ones = ((1 - doubts[rows]) * ones + doubts[rows] / 2).clip(1e-9, 1 - 1e-9)
        ratios[ends[rows] - 1 - bit] = np.log((1 - ones) / ones)
    return ratios


def dithers(secret: bytes, names: Names) -> Doubles:
    """[C, 2] numbers in [0, 1)."""
    return (random_pairs(secret, "dither", names) >> np.uint64(11)) / 2.0**53


def _ungray(code: Integers) -> Integers:
    """The number whose Gray code, number xor half of it, is `code` (up to 8 bits)."""
    for shift in (1, 2, 4):
        code = code ^ code >> shift
    return code
