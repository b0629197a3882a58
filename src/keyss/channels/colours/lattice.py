"""Bits in numbers: dithered quantisation index modulation (Chen and Wornell 2001), read softly.

A number that carries b bits is moved to the nearest point of one of 2^b lattices of step 2^b x spacing, which
lie `spacing` apart and are shifted together by a *dither*, a number that only the key tells and that no two
Gaussians share. So what writing adds is, for whoever has not the key, independent noise that is uniform over
one step, of variance step^2 / 12, and nothing else: no value is likelier than another.

How many bits a Gaussian carries follows from its *impact* and one *level* for all: a bit less for every
factor of four by which a change of its colour shows more, so that all that carry something cost equally much.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from keyss.channels.colours.carriers import Carriers, Doubles, Names
from keyss.channels.colours.fountain import Bits, Ratios
from keyss.channels.mixing import Words, encrypted_blocks, mixed
from keyss.keys.derivation import expand

COLUMNS = 2  # numbers of a Gaussian that are written
MAX_BITS = 5  # of a number
SPACING = 0.0275  # between neighbouring points
LEVELS = 64
_LEVEL_STEP, _MIDDLE = math.log(4) / 4, 44  # of impact; a level is a quarter of a bit
_NOISE = 0.23  # standard deviation of what formats do to a number, of the spacing
_BLOCK = 16

Counts = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Lattice:
    """How many bits each number carries, and which."""

    level: int  # below LEVELS: the more, the more bits
    depth: int = MAX_BITS  # bits of a number, at most: noise stays below half of 2^depth spacings

    def bits(self, carriers: Carriers) -> Counts:
        """[C] bits of each of a carrier's numbers, at most `depth`."""
        water = (self.level - _MIDDLE) * _LEVEL_STEP + MAX_BITS * math.log(4)
        return np.floor((water - carriers.impact) / math.log(4)).clip(0, self.depth).astype(np.int64)

    def noise(self, carriers: Carriers, random: np.random.Generator) -> Doubles:
        """[C, 2] something that is distributed as what writing adds."""
        bits = self.bits(carriers)
        steps = np.where(bits > 0, SPACING * 2.0**bits, 0)
        result: Doubles = random.uniform(-0.5, 0.5, (len(carriers), COLUMNS)) * steps[:, None]
        return result

    def seeds(self, secret: bytes, carriers: Carriers) -> Words:
        """[B] what each bit of all carriers is, as `Fountain` understands it."""
        bits = self.bits(carriers)
        words = _random(secret, "seeds", carriers.names)[:, 0]
        counts = COLUMNS * bits
        first = np.repeat(np.cumsum(counts) - counts, counts)
        order = (np.arange(counts.sum()) - first).astype(np.uint64)
        return mixed(np.repeat(words, counts) ^ mixed(order + np.uint64(1)))

    def write(self, secret: bytes, carriers: Carriers, code: Bits) -> Doubles:
        """[C, 2] new values that carry the bits `code` [B]."""
        bits, dither = self.bits(carriers), dithers(secret, carriers.names)
        ends = COLUMNS * np.cumsum(bits)
        written = carriers.values.copy()
        for each in range(1, MAX_BITS + 1):
            rows = np.flatnonzero(bits == each)
            step = SPACING * 2**each
            for column in range(COLUMNS):
                first = ends[rows] - (COLUMNS - column) * each
                label = np.zeros(len(rows), np.int64)
                for bit in range(each):
                    label = label << 1 | code[first + bit]
                lattice = dither[rows, column] * step + _ungray(label) * SPACING
                nearest = np.round((carriers.values[rows, column] - lattice) / step) * step + lattice
                written[rows, column] = nearest
        return written

    def read(self, secret: bytes, carriers: Carriers, doubt: Doubles) -> Ratios:
        """[B] logarithms of P(0) / P(1); `doubt` [C]: chance that a carrier holds something else."""
        return self.read_dithered(dithers(secret, carriers.names), carriers, doubt)

    def read_dithered(self, dither: Doubles, carriers: Carriers, doubt: Doubles) -> Ratios:
        """The same with dithers [C, 2] that may come from several secrets."""
        bits = self.bits(carriers)
        ends = COLUMNS * np.cumsum(bits)
        ratios = np.zeros(COLUMNS * int(bits.sum()), np.float32)
        for each in range(1, MAX_BITS + 1):
            rows = np.flatnonzero(bits == each)
            for column in range(COLUMNS):
                place = carriers.values[rows, column] / SPACING - dither[rows, column] * 2**each
                place = np.mod(place, 2.0**each)
                points = np.floor(place)[:, None] + np.array([-1.0, 0.0, 1.0, 2.0])
                weight = np.exp(-((place[:, None] - points) ** 2) / (2 * _NOISE**2))
                weight /= weight.sum(axis=1, keepdims=True)
                label = points.astype(np.int64) % (1 << each)
                label ^= label >> 1
                first = ends[rows] - (COLUMNS - column) * each
                for bit in range(each):
                    ones = (weight * (label >> (each - 1 - bit) & 1)).sum(axis=1)
                    ones = ((1 - doubt[rows]) * ones + doubt[rows] / 2).clip(1e-9, 1 - 1e-9)
                    ratios[first + bit] = np.log((1 - ones) / ones)
        return ratios


def dithers(secret: bytes, names: Names) -> Doubles:
    """[C, 2] numbers in [0, 1)."""
    dither: Doubles = (_random(secret, "dither", names) >> np.uint64(11)) / 2.0**53
    return dither


def rank(secret: bytes, label: str, names: Names) -> Words:
    """[C] a number for each name [C, k], k at most 8; equal for equal names."""
    return _random(secret, label, names)[:, 0]


def _random(secret: bytes, label: str, names: Names) -> Words:
    """[C, 2] 64 bits each that nobody can tell from random ones without the secret: AES-256 of the names."""
    blocks = np.zeros((len(names), _BLOCK // 2), "<i2")
    blocks[:, : names.shape[1]] = names
    key = expand(secret, f"robust/{label}", 32)
    return encrypted_blocks(key, blocks.view(np.uint8)).view("<u8").astype(np.uint64)


def _ungray(code: Counts) -> Counts:
    """The number whose Gray code, number xor half of it, is `code` (up to 8 bits)."""
    for shift in (1, 2, 4):
        code = code ^ code >> shift
    return code
