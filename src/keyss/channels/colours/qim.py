"""Dithered quantisation index modulation (Chen and Wornell 2001) with soft decisions.

A value that carries b bits moves to the nearest point of one of 2^b lattices of step 2^b x SPACING. The
lattices are SPACING apart and share a *dither*, an offset derived from key and ID. To others, the change is
therefore independent noise, uniform over one step, of variance step^2 / 12, and no value is likelier than
another.
"""

from __future__ import annotations

import math

import numpy as np

from keyss.channels.colours.carriers import Ids, fractions, random_pairs
from keyss.channels.mixing import mix
from keyss.core.arrays import Bits, Doubles, Flags, Integers, Words

COLUMNS = 2  # modulated values per Gaussian
MAX_BITS = 5  # per value
SPACING = 0.0275  # between neighbouring points
LEVELS = 64
ONE = 0  # level at which every value carries one bit
_BIT = math.log(4)  # impact per bit; a level is a quarter of a bit
_MIDDLE = 24  # level up to which an impact of zero carries nothing
_NOISE = 0.23  # standard deviation of rounding, in spacings
_POINTS = np.array([-1.0, 0.0, 1.0, 2.0])  # candidate points, relative to the one below


def bit_counts(impact: Doubles, level: int) -> Integers:
    """Bits per value [C]: more at higher levels, one less per factor 4 of impact.

    All values that carry bits therefore cost the same.
    """
    if level == ONE:
        return np.ones(len(impact), np.int64)
    return np.floor((level - _MIDDLE) / 4 - impact / _BIT).clip(0, MAX_BITS).astype(np.int64)


def seeds(secret: bytes, label: str, ids: Ids, bits: Integers) -> Words:
    """Seeds [B] for `Fountain` of all bits of Gaussians with `ids`; `bits` [C]: per value."""
    order = mix(np.arange(COLUMNS * MAX_BITS, dtype=np.uint64)).reshape(COLUMNS, MAX_BITS)
    return mix(random_pairs(secret, label, ids)[:, :1, None] ^ order)[_bit_mask(bits)]


def write(secret: bytes, ids: Ids, values: Doubles, bits: Integers, code: Bits) -> Doubles:
    """Modulate `values` [C, 2] with the bits `code` [B], `bits` [C] per value."""
    mask, step = _bit_mask(bits), 2.0 ** bits[:, None]
    gray = np.zeros(mask.shape, np.uint8)
    gray[mask] = code
    weights = 2.0 ** (bits[:, None, None] - 1 - np.arange(MAX_BITS))
    label = (np.bitwise_xor.accumulate(gray, axis=2) * weights * mask).sum(axis=2)
    points = fractions(secret, "dither", ids) * step + label
    new = (np.round((values / SPACING - points) / step) * step + points) * SPACING
    return np.where(bits[:, None] > 0, new, values)


def read(secret: bytes, ids: Ids, values: Doubles, bits: Integers) -> Doubles:
    """Soft decisions [B], P(0) - P(1), for all bits from `write`."""
    period = 2 ** bits[:, None]
    place = np.mod(values / SPACING - fractions(secret, "dither", ids) * period, period)[..., None]
    points = np.floor(place) + _POINTS
    weight = np.exp(-((place - points) ** 2) / (2 * _NOISE**2))
    label = points.astype(np.int64) % period[..., None]
    shifts = (bits[:, None] - 1 - np.arange(MAX_BITS)).clip(0)[:, None, None]
    signs = 1 - 2 * ((label ^ label >> 1)[..., None] >> shifts & 1)  # [C, 2, points, bits]
    hints: Doubles = (weight[..., None] * signs).sum(axis=2) / weight.sum(axis=2)[..., None]
    return hints[_bit_mask(bits)]


def _bit_mask(bits: Integers) -> Flags:
    """Mask [C, COLUMNS, MAX_BITS] of the bits in use."""
    mask: Flags = np.arange(MAX_BITS) < bits[:, None, None]
    return np.repeat(mask, COLUMNS, axis=1)
