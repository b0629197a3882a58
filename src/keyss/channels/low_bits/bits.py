"""The low mantissa bits of a model's floats: where they are, and reading and writing them.

Used are 8 bits of log scales, quaternions and opacity logits, and 12 bits of the spherical harmonics above
the constant ones, of the 23 bits of a mantissa. The last bit of all is left alone: rounding to even makes it
a zero more often than a one, by a third of a percent in spherical harmonics, which a classifier notices.
Positions are not used: the least change can swap two Gaussians of nearly equal depth, and a swap is visible
(48 dB in a view where everything else stays above 79 dB). Nor are constant colours, of which many keep the
few digits that they were initialised with. Nor are the quaternions of a model whose quaternions have unit
length, as tools leave them that normalise: new low bits would change the length, which is known exactly.

What stays of a Gaussian, its position and the high bits, is its *identity*, by which it is known in any
order. Sign and exponent never change. Which Gaussians can be written: `usable`. All functions work through a
model in blocks, so that memory beside the model itself stays small.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from keyss.core.gaussians import Gaussians

IDENTITY_BYTES = 16
FIELDS = ("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3", "opacity")
GEOMETRY = len(FIELDS)  # fields of a Gaussian before the spherical harmonics
QUATS = slice(3, 7)  # of these
GEOMETRY_BITS, SH_BITS = 8, 12
UNUSED_BITS = 1  # below them
UNIT_TOLERANCE = 1e-4  # of a length that is known without the low bits, to 2e-5 on average

_BLOCK = 1 << 16  # Gaussians at a time

Words = npt.NDArray[np.uint32]
Bytes = npt.NDArray[np.uint8]
Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Layout:
    """Which fields of every Gaussian are in use. It follows from what embedding leaves as it is."""

    sh_degree: int
    quats: bool = True

    @staticmethod
    def of(gaussians: Gaussians) -> Layout:
        """Without quaternions where half of them or more have unit length."""
        lengths = [coarse_lengths(_words(part.quats)) for part in blocks(gaussians)]
        deviation = np.abs(np.concatenate(lengths) - 1)
        return Layout(gaussians.sh_degree, not len(deviation) or float(np.median(deviation)) > UNIT_TOLERANCE)

    @property
    def width(self) -> int:
        """Whole bytes that the low bits of one Gaussian hold."""
        return GEOMETRY - 4 * (not self.quats) + _sh_count(self.sh_degree) * 3 // 2

    @property
    def columns(self) -> npt.NDArray[np.int64]:
        """[F'] the fields in use, of those that `used_words` has."""
        every = np.arange(GEOMETRY + _sh_count(self.sh_degree))
        return every if self.quats else np.delete(every, QUATS)

    @property
    def mask(self) -> Words:
        """[F] the bits in use of all fields that `used_words` has."""
        bits = [GEOMETRY_BITS] * GEOMETRY + [SH_BITS] * _sh_count(self.sh_degree)
        mask = np.array([((1 << count) - 1) << UNUSED_BITS for count in bits], np.uint32)
        if not self.quats:
            mask[QUATS] = 0
        return mask


def bytes_per_gaussian(sh_degree: int) -> int:
    """Bytes of one Gaussian's low bits, quaternions included: 8, 21, 44 and 75 at degrees 0 to 3."""
    return Layout(sh_degree).width


def coarse_lengths(quats: Words) -> npt.NDArray[np.float64]:
    """[N] of quaternions [N, 4] with the middle of all low bits that they could have."""
    low = np.uint32((1 << UNUSED_BITS + GEOMETRY_BITS) - 1)
    middle = (quats & ~low | (low + 1) >> 1).view(np.float32).astype(np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        lengths: npt.NDArray[np.float64] = np.sqrt((middle * middle).sum(axis=1))
    return lengths


def identities(gaussians: Gaussians) -> Bytes:
    """[N, 16] for each Gaussian a public hash (BLAKE2b) of all that embedding leaves as it is."""
    hashes, mask = bytearray(), Layout.of(gaussians).mask
    for part in blocks(gaussians):
        rows = np.concatenate([_words(part.means), used_words(part) & ~mask], axis=1)
        data, size = rows.astype("<u4").tobytes(), 4 * rows.shape[1]
        for start in range(0, len(data), size):
            row = data[start : start + size]
            hashes += hashlib.blake2b(row, digest_size=IDENTITY_BYTES, person=b"keyss/identity").digest()
    return np.frombuffer(hashes, np.uint8).reshape(-1, IDENTITY_BYTES)


def read_low_bits(gaussians: Gaussians) -> Bytes:
    """[N, B] the low bits of each Gaussian as bytes, as many as its `Layout` is wide."""
    layout = Layout.of(gaussians)
    parts = ((used_words(part) & layout.mask)[:, layout.columns] for part in blocks(gaussians))
    return np.concatenate([_packed(low, layout) for low in parts])


def write_low_bits(gaussians: Gaussians, rows: npt.NDArray[np.int64], data: Bytes) -> Gaussians:
    """The same Gaussians with other low bits [R, B] in the `rows` [R], which are different ones.

    Where a Gaussian's bits are no whole number of bytes, the last half byte stays as it is.
    """
    layout = Layout.of(gaussians)
    mask = layout.mask
    if _sh_count(layout.sh_degree) % 2:  # 12 bits are a byte and a half
        mask[-1] &= ~np.uint32(15 << UNUSED_BITS)
    order = np.argsort(rows)
    ascending = rows[order]
    parts = []
    for start, part in zip(range(0, len(gaussians), _BLOCK), blocks(gaussians), strict=True):
        first, last = np.searchsorted(ascending, (start, start + len(part)))
        own, used = ascending[first:last] - start, used_words(part)
        new = np.zeros((len(own), used.shape[1]), np.uint32)
        new[:, layout.columns] = _unpacked(data[order[first:last]], layout)
        used[own] = used[own] & ~mask | new & mask
        parts.append(_with_used(part, used))
    return Gaussians.cat(parts)


def blocks(gaussians: Gaussians) -> Iterator[Gaussians]:
    """The model in parts; one that is empty for a model that is."""
    return (gaussians[start : start + _BLOCK] for start in range(0, max(len(gaussians), 1), _BLOCK))


def used_words(gaussians: Gaussians) -> Words:
    """[N, F] bit patterns of scales, quaternions, opacity and harmonics above the constant ones; a copy."""
    fields = (gaussians.log_scales, gaussians.quats, gaussians.opacity_logits, gaussians.sh[:, 1:])
    return np.concatenate([_words(values) for values in fields], axis=1)


def _sh_count(sh_degree: int) -> int:
    """Spherical harmonics above the constant ones, of three colours."""
    return 3 * ((sh_degree + 1) ** 2 - 1)


def _packed(low: Words, layout: Layout) -> Bytes:
    """[N, B] the bytes of the masked words [N, F'] of the fields in use."""
    low = low >> np.uint32(UNUSED_BITS)
    before = low.shape[1] - _sh_count(layout.sh_degree)
    sh = low[:, before:]
    if sh.shape[1] % 2:
        sh = np.concatenate([sh, np.zeros((len(sh), 1), np.uint32)], axis=1)
    first, second = sh[:, 0::2], sh[:, 1::2]  # two times 12 bits are three bytes
    packed = np.stack([first >> 4, (first & 15) << 4 | second >> 8, second & 255], axis=2)
    table = np.concatenate([low[:, :before], packed.reshape(len(low), -1)], axis=1)
    return table[:, : layout.width].astype(np.uint8)


def _unpacked(data: Bytes, layout: Layout) -> Words:
    """[N, F'] the words of bytes [N, B]: the inverse of `_packed`, zeros where a byte is missing."""
    count = _sh_count(layout.sh_degree)
    before = len(layout.columns) - count
    padded = np.zeros((len(data), -(-count // 2) * 3), np.uint32)
    padded[:, : data.shape[1] - before] = data[:, before:]
    a, b, c = padded[:, 0::3], padded[:, 1::3], padded[:, 2::3]
    sh = np.stack([a << 4 | b >> 4, (b & 15) << 8 | c], axis=2).reshape(len(data), -1)[:, :count]
    return np.concatenate([data[:, :before], sh], axis=1) << np.uint32(UNUSED_BITS)


def _words(values: torch.Tensor) -> Words:
    flat = values.detach().to("cpu", torch.float32).reshape(len(values), -1).contiguous()
    return flat.numpy().view(np.uint32)


def _with_used(gaussians: Gaussians, used: Words) -> Gaussians:
    values = torch.from_numpy(used.view(np.float32)).to(gaussians.device)
    log_scales, quats, opacity_logits, rest = values.split((3, 4, 1, values.shape[1] - GEOMETRY), dim=1)
    sh = torch.cat([gaussians.sh[:, :1], rest.reshape(len(values), -1, 3)], dim=1)
    opacity_logits = opacity_logits[:, 0].contiguous()
    return Gaussians(gaussians.means, quats.contiguous(), log_scales.contiguous(), opacity_logits, sh)
