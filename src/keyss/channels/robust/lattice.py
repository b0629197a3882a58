"""Bits in numbers: dithered quantisation index modulation (Chen and Wornell 2001), read softly.

A number that carries b bits is moved to the nearest point of one of 2^b lattices of step 2^b x spacing, which lie
`spacing` apart and are shifted together by a *dither*, a number that only the key tells and that no two
Gaussians share. So what writing adds is, for whoever has not the key, independent noise that is uniform over
one step, of variance step^2 / 12, and nothing else: no value is likelier than another.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from cryptography.hazmat.primitives.ciphers import Cipher
from cryptography.hazmat.primitives.ciphers.algorithms import AES
from cryptography.hazmat.primitives.ciphers.modes import ECB

from keyss.channels.robust.carriers import Carriers, Doubles
from keyss.channels.robust.fountain import Bits, Numbers, Words, mixed
from keyss.keys.derivation import expand

_NOISE = 0.23  # standard deviation of what formats do to a number, of the spacing
_COLUMNS = 2  # numbers of a Gaussian
_MOST_BITS = 8

_BLOCK = 16


@dataclass(frozen=True)
class Lattice:
    """`bits`: of green and of blue, each up to 8. `spacing`: between neighbouring points."""

    bits: tuple[int, int]
    spacing: float

    @property
    def each(self) -> int:
        """Bits of a Gaussian."""
        return sum(self.bits)

    @property
    def variance(self) -> float:
        """Of what writing adds to a number, the mean of both."""
        return sum((self.spacing * 2**bits) ** 2 / 12 if bits else 0.0 for bits in self.bits) / _COLUMNS

    def seeds(self, secret: bytes, carriers: Carriers) -> Words:
        """[C, each] what each bit of the carriers is, as `Fountain` understands it."""
        words = _random(secret, "seeds", carriers)[:, :1]
        order = np.arange(self.each, dtype=np.uint64)
        return mixed(words ^ mixed(order + np.uint64(1)))

    def write(self, secret: bytes, carriers: Carriers, code: Bits) -> Doubles:
        """[C, 2] new green and blue that carry the bits `code` [C, each]."""
        dither = self._dither(secret, carriers)
        written, first = carriers.values.copy(), 0
        for column, bits in enumerate(self.bits):
            if bits:
                label = np.zeros(len(carriers), np.int64)
                for bit in range(bits):
                    label = label << 1 | code[:, first + bit]
                step = self.spacing * 2**bits
                lattice = dither[:, column] * step + _ungray(label) * self.spacing
                written[:, column] = np.round((carriers.values[:, column] - lattice) / step) * step + lattice
            first += bits
        return written

    def read(self, secret: bytes, carriers: Carriers, doubt: Doubles) -> Numbers:
        """[C, each] logarithms of P(0) / P(1); `doubt` [C]: chance that a carrier holds something else."""
        dither = self._dither(secret, carriers)
        ratios = np.zeros((len(carriers), self.each), np.float32)
        first = 0
        for column, bits in enumerate(self.bits):
            step = self.spacing * 2**bits
            place = (carriers.values[:, column] - dither[:, column] * step) / self.spacing
            place = np.mod(place, 2.0**bits)
            points = np.floor(place)[:, None] + np.array([-1.0, 0.0, 1.0, 2.0])
            weight = np.exp(-((place[:, None] - points) ** 2) / (2 * _NOISE**2))
            label = points.astype(np.int64) % (1 << bits)
            label ^= label >> 1
            for bit in range(bits):
                ones = (weight * (label >> (bits - 1 - bit) & 1)).sum(axis=1) / weight.sum(axis=1)
                ones = (1 - doubt) * ones + doubt / 2
                ratios[:, first + bit] = np.log((1 - ones).clip(1e-9) / ones.clip(1e-9))
            first += bits
        return ratios

    def fit(self, secret: bytes, carriers: Carriers) -> float:
        """How well the values lie on the lattice: 0 by chance, 1 on its points."""
        dither, places = self._dither(secret, carriers), []
        for column, bits in enumerate(self.bits):
            if bits:
                place = carriers.values[:, column] / self.spacing - dither[:, column] * 2**bits
                places.append(np.cos(2 * np.pi * place))
        return float(np.mean(places))

    def _dither(self, secret: bytes, carriers: Carriers) -> Doubles:
        """[C, 2] numbers in [0, 1)."""
        dither: Doubles = (_random(secret, "dither", carriers) >> np.uint64(11)) / 2.0**53
        return dither


def rank(secret: bytes, label: str, names: npt.NDArray[np.int16]) -> Words:
    """[C] a number for each name [C, k], k at most 8; equal for equal names."""
    return _encrypted(expand(secret, f"robust/{label}", 32), names)[:, 0]


def _random(secret: bytes, label: str, carriers: Carriers) -> Words:
    """[C, 2] 64 bits each that nobody can tell from random ones without the secret."""
    return _encrypted(expand(secret, f"robust/{label}", 32), carriers.names)


def _encrypted(key: bytes, names: npt.NDArray[np.int16]) -> Words:
    """[C, 2] of AES-256 of the names [C, k]: a pseudo-random function of them."""
    blocks = np.zeros((len(names), _BLOCK // 2), "<i2")
    blocks[:, : names.shape[1]] = names
    cipher = Cipher(AES(key), ECB()).encryptor()
    words = np.frombuffer(cipher.update(blocks.tobytes()), "<u8").reshape(len(names), 2)
    return words.astype(np.uint64)


def _ungray(code: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """The number whose Gray code, number xor half of it, is `code` (up to 8 bits)."""
    for shift in (1, 2, 4):
        code = code ^ code >> shift
    return code
