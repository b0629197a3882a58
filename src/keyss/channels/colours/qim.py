"""Bits in numbers: dithered quantisation index modulation (Chen and Wornell 2001), read softly.

A number that carries b bits is moved to the nearest point of one of 2^b lattices of step 2^b x SPACING. They
lie SPACING apart and are shifted together by a *dither*, a number that only the key tells and that no two
Gaussians share. So without the key the change is independent noise, uniform over one step, of variance
step^2 / 12, and no value is likelier than another.
"""

from __future__ import annotations

import math

import numpy as np

from keyss.channels.colours.carriers import Names, fractions, random_pairs
from keyss.channels.mixing import mix
from keyss.core.arrays import Bits, Doubles, Flags, Integers, Words

COLUMNS = 2  # numbers of a Gaussian that are written
MAX_BITS = 5  # of a number
SPACING = 0.0275  # between neighbouring points
LEVELS = 64
ONE = 0  # the level at which every number carries one bit
_BIT = math.log(4)  # of impact; a level is a quarter of a bit
_MIDDLE = 24  # level at which an impact of zero carries nothing any more
_NOISE = 0.23  # standard deviation of a format's rounding, in spacings
_POINTS = np.array([-1.0, 0.0, 1.0, 2.0])  # that a number may have come from, from the one below on


def bit_counts(impact: Doubles, level: int) -> Integers:
    """[C] bits of each number of carriers: more at a higher level, and one less for four times the impact.

    So all numbers that carry something cost equally much.
    """
    if level == ONE:
        return np.ones(len(impact), np.int64)
    return np.floor((level - _MIDDLE) / 4 - impact / _BIT).clip(0, MAX_BITS).astype(np.int64)


def seeds(secret: bytes, label: str, names: Names, bits: Integers) -> Words:
    """[B] the seeds of all bits of Gaussians with these names, for `Fountain`; `bits` [C]: of each number."""
    order = mix(np.arange(COLUMNS * MAX_BITS, dtype=np.uint64)).reshape(COLUMNS, MAX_BITS)
    return mix(random_pairs(secret, label, names)[:, :1, None] ^ order)[_bit_mask(bits)]


def write(secret: bytes, names: Names, values: Doubles, bits: Integers, code: Bits) -> Doubles:
    """[C, 2] new `values` of carriers that hold the bits `code` [B], `bits` [C] in each number."""
    carried, step = _bit_mask(bits), 2.0 ** bits[:, None]
    gray = np.zeros(carried.shape, np.uint8)
    gray[carried] = code
    weights = 2.0 ** (bits[:, None, None] - 1 - np.arange(MAX_BITS))
    label = (np.bitwise_xor.accumulate(gray, axis=2) * weights * carried).sum(axis=2)
    points = fractions(secret, "dither", names) * step + label
    new = (np.round((values / SPACING - points) / step) * step + points) * SPACING
    return np.where(bits[:, None] > 0, new, values)


def read(secret: bytes, names: Names, values: Doubles, bits: Integers) -> Doubles:
    """[B] P(0) - P(1) of all bits of carriers that `write` has written."""
    period = 2 ** bits[:, None]
    place = np.mod(values / SPACING - fractions(secret, "dither", names) * period, period)[..., None]
    points = np.floor(place) + _POINTS
    weight = np.exp(-((place - points) ** 2) / (2 * _NOISE**2))
    label = points.astype(np.int64) % period[..., None]
    shifts = (bits[:, None] - 1 - np.arange(MAX_BITS)).clip(0)[:, None, None]
    signs = 1 - 2 * ((label ^ label >> 1)[..., None] >> shifts & 1)  # [C, 2, points, bits]
    hints: Doubles = (weight[..., None] * signs).sum(axis=2) / weight.sum(axis=2)[..., None]
    return hints[_bit_mask(bits)]


def _bit_mask(bits: Integers) -> Flags:
    """[C, COLUMNS, MAX_BITS] which bits there are."""
    carried: Flags = np.arange(MAX_BITS) < bits[:, None, None]
    return np.repeat(carried, COLUMNS, axis=1)
