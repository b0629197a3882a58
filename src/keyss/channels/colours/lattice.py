"""Bits in numbers: dithered quantisation index modulation (Chen and Wornell 2001), read softly.

A number that carries a bit is moved to the nearest point of one of two lattices of step 2 x SPACING. They lie
SPACING apart and are shifted together by a *dither*, a number that only the key tells and that no two
Gaussians share. So without the key the change is independent noise, uniform over one step, of variance
step^2 / 12, and no value is likelier than another.

The change is so small that views keep about 49 dB in green and blue even if each pixel shows one Gaussian.
"""

from __future__ import annotations

import numpy as np

from keyss.channels.colours.carriers import Carriers, Doubles, Names
from keyss.channels.colours.fountain import Bits, Ratios
from keyss.channels.mixing import Words, encrypted_blocks, mixed
from keyss.keys.derivation import expand

COLUMNS = 2  # numbers of a Gaussian that are written
SPACING = 0.0275  # between the points of both lattices
STEP = 2 * SPACING
_NOISE = 0.23  # standard deviation of a format's rounding, in spacings
_BLOCK = 16
_POINTS = np.array([-1.0, 0.0, 1.0, 2.0])  # that a number may have come from, from the one below on


def seeds(secret: bytes, label: str, names: Names) -> Words:
    """[2 C] the seeds of all numbers of Gaussians with these names, for `Fountain`."""
    words = rank(secret, label, names)
    return mixed((words[:, None] ^ mixed(np.arange(1, 1 + COLUMNS, dtype=np.uint64))).ravel())


def write(secret: bytes, carriers: Carriers, bits: Bits) -> Doubles:
    """[C, 2] new values that carry `bits` [2 C]."""
    points = dithers(secret, carriers.names) * STEP + bits.reshape(-1, COLUMNS) * SPACING
    values: Doubles = np.round((carriers.values - points) / STEP) * STEP + points
    return values


def read(dither: Doubles, carriers: Carriers, doubt: Doubles) -> Ratios:
    """[2 C] logarithms of P(0) / P(1) of each bit.

    `dither` [C, 2]: of `dithers`. `doubt` [C]: the chance that a carrier holds something else.
    """
    place = np.mod(carriers.values / SPACING - 2 * dither, 2.0)[:, :, None]
    points = np.floor(place) + _POINTS
    weight = np.exp(-((place - points) ** 2) / (2 * _NOISE**2))
    ones = (weight * (points % 2)).sum(axis=2) / weight.sum(axis=2)
    ones = ((1 - doubt[:, None]) * ones + doubt[:, None] / 2).clip(1e-9, 1 - 1e-9)
    ratios: Ratios = np.log((1 - ones) / ones).astype(np.float32).ravel()
    return ratios


def dithers(secret: bytes, names: Names) -> Doubles:
    """[C, 2] numbers in [0, 1)."""
    dither: Doubles = (_random(secret, "dither", names) >> np.uint64(11)) / 2.0**53
    return dither


def rank(secret: bytes, label: str, names: Names) -> Words:
    """[C] a number for each name [C, k], k at most 8; equal for equal names."""
    return _random(secret, label, names)[:, 0]


def _random(secret: bytes, label: str, names: Names) -> Words:
    """[C, 2] 64 bits each, pseudo-random without the secret: AES-256 of the names."""
    blocks = np.zeros((len(names), _BLOCK // 2), "<i2")
    blocks[:, : names.shape[1]] = names
    key = expand(secret, f"colours/{label}", 32)
    return encrypted_blocks(key, blocks.view(np.uint8)).view("<u8").astype(np.uint64)
