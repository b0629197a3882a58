"""The low mantissa bits of a model's floats: where they are, and reading and writing them.

Used are 8 bits of log scales, quaternions and opacity logits, and 12 bits of the spherical harmonics above
the constant ones, of the 23 bits of a mantissa. The last bit of all is left alone: rounding to even makes it
a zero more often than a one, by a third of a percent in spherical harmonics, which a classifier notices.
Positions are not used: the least change can swap two Gaussians of nearly equal depth, and a swap is visible
(48 dB in a view where everything else stays above 79 dB). Nor are constant colours, of which many keep the
few digits that they were initialised with. Nor are the quaternions of a model whose quaternions have unit
length, as tools leave them that normalise: new low bits would change the length, which is known exactly.

What stays of a Gaussian, its position and the high bits, is its *identity*, by which it is known in any
order. Sign and exponent never change. Which Gaussians can be written: `usable`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, fields
from hashlib import blake2b

import numpy as np
import torch
from torch.autograd.graph import increment_version

from keyss.core.arrays import Bytes, Doubles, Integers, Words32
from keyss.core.gaussians import Gaussians
from keyss.kernels.parallel import in_blocks

FIELDS = ("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3", "opacity")
GEOMETRY = len(FIELDS)  # fields of a Gaussian before the spherical harmonics
QUATS = slice(3, 7)  # of these
GEOMETRY_BITS, SH_BITS = 8, 12
UNUSED_BITS = 1  # below them
_UNUSED = np.uint32(UNUSED_BITS)
_BYTE, _TWELVE = np.uint32((1 << GEOMETRY_BITS) - 1), np.uint32((1 << SH_BITS) - 1)
UNIT_TOLERANCE = 1e-4  # of a length that is known without the low bits, to 2e-5 on average

IDENTITY_BYTES = 16
_PERSON = b"keyss/identity"
BLOCK = 1 << 13  # Gaussians that a thread takes at a time


@dataclass(frozen=True)
class Layout:
    """Which fields of every Gaussian are in use. It follows from what embedding leaves as it is."""

    sh_degree: int
    quats: bool = True
    written_degree: int | None = None  # of the harmonics whose low bits are read and written; None: all

    @staticmethod
    def of(gaussians: Gaussians) -> Layout:
        """Without quaternions where half of them or more have unit length."""
        words = _words(gaussians.quats)
        lengths = in_blocks(lambda start, stop: coarse_lengths(words[start:stop]), len(words), BLOCK)
        away = float(np.median(np.abs(np.concatenate(lengths) - 1))) if lengths else 1.0
        return Layout(gaussians.sh_degree, away > UNIT_TOLERANCE)

    @property
    def width(self) -> int:
        """Whole bytes that the low bits of one Gaussian hold: 8, 21, 44 and 75 at degrees 0 to 3."""
        return GEOMETRY - 4 * (not self.quats) + self.harmonics * 3 // 2

    @property
    def harmonics(self) -> int:
        """Fields of spherical harmonics that are read and written."""
        return _sh_count(self.sh_degree if self.written_degree is None else self.written_degree)

    @property
    def columns(self) -> Integers:
        """[F'] the fields in use, of those that `used_words` has."""
        every = np.arange(GEOMETRY + _sh_count(self.sh_degree))
        return every if self.quats else np.delete(every, QUATS)

    @property
    def mask(self) -> Words32:
        """[F] the bits in use of all fields that `used_words` has."""
        bits = [GEOMETRY_BITS] * GEOMETRY + [SH_BITS] * _sh_count(self.sh_degree)
        mask = np.array([((1 << count) - 1) << UNUSED_BITS for count in bits], np.uint32)
        if not self.quats:
            mask[QUATS] = 0
        return mask

    @property
    def shifts(self) -> Words32:
        """[F] by which a word is shifted so that the bits in use, and those below them, are gone."""
        return np.array([int(each).bit_length() for each in self.mask], np.uint32)


def coarse_lengths(quats: Words32) -> Doubles:
    """[N] of quaternions [N, 4] with the middle of all low bits that they could have."""
    low = np.uint32((1 << UNUSED_BITS + GEOMETRY_BITS) - 1)
    with np.errstate(over="ignore", invalid="ignore"):
        middle = (quats & ~low | (low + 1) >> 1).view(np.float32).astype(np.float64)
        lengths: Doubles = np.sqrt((middle * middle).sum(axis=1))
    return lengths


def identities(gaussians: Gaussians, layout: Layout | None = None) -> Bytes:
    """[N, 16] for each Gaussian a public hash (BLAKE2b) of all that embedding leaves as it is."""
    stays, hashes = ~(layout or Layout.of(gaussians)).mask, []
    size = 4 * (3 + len(stays))
    for start in range(0, len(gaussians), BLOCK):
        own = gaussians[start : start + BLOCK]
        data = np.concatenate([_words(own.means), used_words(own) & stays], axis=1).astype("<u4").tobytes()
        each = (
            blake2b(data[at : at + size], digest_size=IDENTITY_BYTES, person=_PERSON).digest()
            for at in range(0, len(data), size)
        )
        hashes.append(b"".join(each))
    return np.frombuffer(b"".join(hashes), np.uint8).reshape(-1, IDENTITY_BYTES)


def read_low_bits(gaussians: Gaussians, layout: Layout | None = None) -> Bytes:
    """[N, B] the low bits of each Gaussian as bytes, as many as its `Layout` is wide.

    8 bits of each field before the harmonics are a byte; two times 12 bits of harmonics are three.
    """
    layout = layout or Layout.of(gaussians)
    fields, harmonics = _written_fields(gaussians, layout)
    packed = np.empty((len(gaussians), layout.width), np.uint8)

    def pack(start: int, stop: int) -> None:
        own, at = packed[start:stop], layout.width - harmonics.shape[1] * 3 // 2
        own[:, :at] = np.concatenate([field[start:stop] for field in fields], axis=1) >> _UNUSED & _BYTE
        low = harmonics[start:stop] >> _UNUSED & _TWELVE
        first, second = low[:, ::2], low[:, 1::2]
        middle = first << 4 & _BYTE
        middle[:, : second.shape[1]] |= second >> 8
        own[:, at::3], own[:, at + 1 :: 3] = first >> 4, middle[:, : second.shape[1]]
        own[:, at + 2 :: 3] = second & _BYTE

    in_blocks(pack, len(gaussians), BLOCK)
    return packed


def write_low_bits(
    gaussians: Gaussians,
    layout: Layout,
    parts: Iterable[tuple[Integers, Bytes]],
    *,
    in_place: bool = False,
) -> Gaussians:
    """The same Gaussians with other low bits: for each part [R, B] in the rows [R], which are different ones.

    Where a Gaussian's bits are no whole number of bytes, the last half byte stays as it is. `in_place`: the
    result may share its memory with `gaussians`, which are changed.
    """
    written = gaussians.detach().to("cpu").map(torch.Tensor.contiguous)
    if in_place:
        for field in fields(written):
            increment_version(getattr(written, field.name))  # NumPy writes, which PyTorch does not see
    else:
        written = written.map(torch.clone)
    geometry, harmonics = _written_fields(written, layout)

    for rows, data in parts:

        def write(start: int, stop: int, rows: Integers = rows, data: Bytes = data) -> None:
            own, new, at = rows[start:stop], data[start:stop].astype(np.uint32), 0
            for field in geometry:
                low = new[:, at : (at := at + field.shape[1])]
                field[own] = field[own] & ~(_BYTE << _UNUSED) | low << _UNUSED
            low = harmonics[own] >> _UNUSED & _TWELVE
            middle, last = new[:, at + 1 :: 3], new[:, at + 2 :: 3]
            low[:, ::2] = low[:, ::2] & np.uint32(15) | new[:, at::3] << 4
            paired = low[:, : 2 * middle.shape[1]]
            paired[:, ::2] = paired[:, ::2] & ~np.uint32(15) | middle >> 4
            paired[:, 1::2] = (middle & np.uint32(15)) << 8 | last
            harmonics[own] = harmonics[own] & ~(_TWELVE << _UNUSED) | low << _UNUSED

        in_blocks(write, len(rows), BLOCK)
    return written.to(gaussians.device)


def used_words(gaussians: Gaussians) -> Words32:
    """[N, F] bit patterns of scales, quaternions, opacity and harmonics above the constant ones; a copy."""
    return np.concatenate([_words(values) for values in _used_fields(gaussians)], axis=1)


def _used_fields(gaussians: Gaussians) -> tuple[torch.Tensor, ...]:
    return gaussians.log_scales, gaussians.quats, gaussians.opacity_logits, gaussians.sh[:, 1:]


def _written_fields(gaussians: Gaussians, layout: Layout) -> tuple[list[Words32], Words32]:
    """The bit patterns of scales, of quaternions if in use, and of opacities; then those of harmonics."""
    *geometry, harmonics = map(_words, _used_fields(gaussians))
    kept = [each for each in geometry if layout.quats or each.shape[1] != 4]
    return kept, harmonics[:, : layout.harmonics]


def _sh_count(sh_degree: int) -> int:
    """Spherical harmonics above the constant ones, of three colours."""
    return 3 * ((sh_degree + 1) ** 2 - 1)


def _words(values: torch.Tensor) -> Words32:
    """[N, C] bit patterns: of a tensor on the CPU whose rows are contiguous its own memory."""
    flat = values.detach().to("cpu", torch.float32).reshape(len(values), math.prod(values.shape[1:]))
    return flat.numpy().view(np.uint32)
