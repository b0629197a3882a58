"""The low mantissa bits of a model's floats: where they are, and reading and writing them.

Of the 23 bits of a mantissa, 8 are used in log scales, quaternions and opacity logits, and 12 in the
spherical harmonics above the constant ones. The last bit is left alone: rounding to even makes it a zero
more often than a one, by a third of a percent in spherical harmonics, which a classifier notices.
Positions are not used: the least change can swap two Gaussians of nearly equal depth, and a swap is visible
(48 dB in a view where everything else stays above 79 dB). Constant colours are not used: many keep the few
digits of their initial values. Unit quaternions, which some tools write, are not used: new low bits would
change their length, which is known exactly.

The *ID* of a Gaussian is a hash of its position and high bits, which embedding never changes: it replaces the
index, so the order of Gaussians does not matter. `usable` selects the Gaussians that may be written.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import torch

from keyss.core.arrays import Bytes, Doubles, Integers, Words32
from keyss.core.gaussians import Gaussians
from keyss.kernels.blake2b import blake2b_rows
from keyss.kernels.parallel import in_blocks

FIELDS = ("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3", "opacity")
GEOMETRY = len(FIELDS)  # fields of a Gaussian before the spherical harmonics
QUATS = slice(3, 7)  # their columns in FIELDS
GEOMETRY_BITS, SH_BITS = 8, 12
UNUSED_BITS = 1  # lowest bits of the mantissa, never written
_UNUSED = np.uint32(UNUSED_BITS)
_BYTE, _TWELVE = np.uint32((1 << GEOMETRY_BITS) - 1), np.uint32((1 << SH_BITS) - 1)
UNIT_TOLERANCE = 1e-4  # of a quaternion's length; without low bits it has an error of 2e-5 on average

ID_BYTES = 16
_PERSON = b"keyss/identity"
BLOCK = 1 << 13  # Gaussians that a thread takes at a time


@dataclass(frozen=True)
class Layout:
    """The fields in use, a function of the bits that embedding never changes."""

    sh_degree: int
    quats: bool = True
    written_degree: int | None = None  # SH degree up to which low bits are read and written; None: all

    @staticmethod
    def of(gaussians: Gaussians) -> Layout:
        """Without quaternions where half of them or more have unit length."""
        words = _words(gaussians.quats)
        lengths = in_blocks(lambda start, stop: coarse_lengths(words[start:stop]), len(words), BLOCK)
        away = float(np.median(np.abs(np.concatenate(lengths) - 1))) if lengths else 1.0
        return Layout(gaussians.sh_degree, away > UNIT_TOLERANCE)

    @property
    def width(self) -> int:
        """Whole bytes in the low bits of one Gaussian: 8, 21, 44 and 75 at degrees 0 to 3."""
        return GEOMETRY - 4 * (not self.quats) + self.harmonics * 3 // 2

    @property
    def harmonics(self) -> int:
        """Fields of spherical harmonics that are read and written."""
        return _sh_count(self.sh_degree if self.written_degree is None else self.written_degree)

    @property
    def columns(self) -> Integers:
        """[F'] the columns of `used_words` in use."""
        every = np.arange(GEOMETRY + _sh_count(self.sh_degree))
        return every if self.quats else np.delete(every, QUATS)

    @property
    def mask(self) -> Words32:
        """[F] masks of the bits in use, for the columns of `used_words`."""
        bits = [GEOMETRY_BITS] * GEOMETRY + [SH_BITS] * _sh_count(self.sh_degree)
        mask = np.array([((1 << count) - 1) << UNUSED_BITS for count in bits], np.uint32)
        if not self.quats:
            mask[QUATS] = 0
        return mask

    @property
    def shifts(self) -> Words32:
        """[F] right shifts that drop the bits in use and those below."""
        return np.array([int(each).bit_length() for each in self.mask], np.uint32)


def coarse_lengths(quats: Words32) -> Doubles:
    """[N] lengths of quaternions [N, 4] whose low bits are replaced by the middle of their range."""
    low = np.uint32((1 << UNUSED_BITS + GEOMETRY_BITS) - 1)
    with np.errstate(over="ignore", invalid="ignore"):
        middle = (quats & ~low | (low + 1) >> 1).view(np.float32).astype(np.float64)
        lengths: Doubles = np.sqrt((middle * middle).sum(axis=1))
    return lengths


def gaussian_ids(gaussians: Gaussians, layout: Layout | None = None) -> Bytes:
    """[N, 16] IDs of the Gaussians: public hashes (BLAKE2b) of the bits that embedding never changes."""
    stays = ~(layout or Layout.of(gaussians)).mask

    def ids(start: int, stop: int) -> Bytes:
        own = gaussians[start:stop]
        return blake2b_rows(np.concatenate([_words(own.means), used_words(own) & stays], axis=1), _PERSON)

    return np.concatenate([np.zeros((0, ID_BYTES), np.uint8), *in_blocks(ids, len(gaussians), BLOCK)])


def read_low_bits(gaussians: Gaussians, layout: Layout | None = None) -> Bytes:
    """[N, B] the low bits of each Gaussian, B = `layout.width`.

    A field before the harmonics gives one byte, two harmonics of 12 bits give three.
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
    gaussians: Gaussians, layout: Layout, parts: Iterable[tuple[Integers, Bytes]]
) -> Gaussians:
    """Replace low bits: each of `parts` has distinct rows [R] and their new bytes [R, B].

    If a Gaussian has half a byte more than B bytes, that half byte keeps its value.
    """
    written = gaussians.detach().to("cpu").map(torch.Tensor.contiguous).map(torch.clone)
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
    """[N, F] new bit patterns of log scales, quaternions, opacity logits and harmonics above degree 0."""
    return np.concatenate(list(group_words(gaussians)), axis=1)


def group_words(gaussians: Gaussians) -> Iterator[Words32]:
    """The columns [N, C] of `used_words` by group; views where possible."""
    groups = gaussians.log_scales, gaussians.quats, gaussians.opacity_logits, gaussians.sh[:, 1:]
    return map(_words, groups)


def _written_fields(gaussians: Gaussians, layout: Layout) -> tuple[list[Words32], Words32]:
    """Bit patterns of log scales, quaternions (if in use) and opacity logits; and of harmonics."""
    *geometry, harmonics = group_words(gaussians)
    kept = [each for each in geometry if layout.quats or each.shape[1] != 4]
    return kept, harmonics[:, : layout.harmonics]


def _sh_count(sh_degree: int) -> int:
    """Number of coefficients above degree 0, three colours each."""
    return 3 * ((sh_degree + 1) ** 2 - 1)


def _words(values: torch.Tensor) -> Words32:
    """[N, C] bit patterns; a view for contiguous float32 tensors on the CPU."""
    flat = values.detach().to("cpu", torch.float32).reshape(len(values), math.prod(values.shape[1:]))
    return flat.numpy().view(np.uint32)
