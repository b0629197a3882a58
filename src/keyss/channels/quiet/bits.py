"""The low mantissa bits of a model's floats: where they are, and reading and writing them.

A file has one *depth* d of DEPTHS: bits 1 to d of the mantissas of log scales, quaternions, opacity logits
and the spherical harmonics above the constant ones may be replaced. Bit 0 is left alone: rounding to even
makes it a zero more often than a one, by a third of a percent in spherical harmonics, which a classifier
notices. Positions are not used: the least change can swap two Gaussians of nearly equal depth, and a swap is
visible (48 dB in a view where everything else stays above 79 dB). Constant colours are not used: many keep
the few digits of their initial values. Unit quaternions, which some tools write, are not used: new low bits
would change their length, which is known exactly.

The *ID* of a Gaussian is a hash of its position and of the bits that no depth replaces: it stands for the
index, so the order of Gaussians does not matter.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import torch

from keyss.core.arrays import Bits, Bytes, Doubles, Integers, Words32
from keyss.core.gaussians import Gaussians
from keyss.kernels.blake2b import blake2b_rows
from keyss.kernels.parallel import in_blocks

GEOMETRY = 8  # fields before the harmonics: three log scales, four parts of a quaternion, opacity logit
QUATS = slice(3, 7)
DEPTHS = (4, 6, 8)  # bits of a field that are replaced
LEAST, DEEPEST = DEPTHS[0], DEPTHS[-1]
LOW = np.uint32((1 << DEEPEST + 1) - 1)  # mask of the bits that some depth replaces, and of bit 0
UNIT_TOLERANCE = 1e-4  # of a quaternion's length; without low bits it has an error of 2e-5 on average

ID_BYTES = 16
_PERSON = b"keyss/identity"
BLOCK = 1 << 13  # Gaussians that a thread takes at a time


@dataclass(frozen=True)
class Layout:
    """The fields in use, a function of the bits that embedding never changes."""

    sh_degree: int
    quats: bool = True

    @staticmethod
    def of(gaussians: Gaussians) -> Layout:
        """Without quaternions where half of them or more have unit length."""
        words = _words(gaussians.quats)
        lengths = in_blocks(lambda start, stop: coarse_lengths(words[start:stop]), len(words), BLOCK)
        away = float(np.median(np.abs(np.concatenate(lengths) - 1))) if lengths else 1.0
        return Layout(gaussians.sh_degree, away > UNIT_TOLERANCE)

    def width(self, depth: int) -> int:
        """Whole bytes in the low bits of one Gaussian: at depth 8 one for each field in use."""
        return len(self.columns) * depth // 8

    @property
    def columns(self) -> Integers:
        """[F'] the columns of `used_words` in use."""
        every = np.arange(GEOMETRY + 3 * ((self.sh_degree + 1) ** 2 - 1))
        return every if self.quats else np.delete(every, QUATS)


def coarse_lengths(quats: Words32) -> Doubles:
    """[N] lengths of quaternions [N, 4] whose low bits are replaced by the middle of their range."""
    with np.errstate(over="ignore", invalid="ignore"):
        middle = (quats & ~LOW | (LOW + 1) >> 1).view(np.float32).astype(np.float64)
        lengths: Doubles = np.sqrt((middle * middle).sum(axis=1))
    return lengths


def gaussian_ids(gaussians: Gaussians, layout: Layout | None = None) -> Bytes:
    """[N, 16] IDs of the Gaussians: public hashes (BLAKE2b) of the bits that embedding never changes."""
    columns = (layout or Layout.of(gaussians)).columns

    def ids(start: int, stop: int) -> Bytes:
        own = gaussians[start:stop]
        used = used_words(own)
        used[:, columns] &= ~LOW | np.uint32(1)
        return blake2b_rows(np.concatenate([_words(own.means), used], axis=1), _PERSON)

    return np.concatenate([np.zeros((0, ID_BYTES), np.uint8), *in_blocks(ids, len(gaussians), BLOCK)])


def read_low_bits(gaussians: Gaussians, depth: int = DEEPEST, layout: Layout | None = None) -> Bytes:
    """[N, B] the low bits of each Gaussian, field after field, the highest bit first; B = `layout.width`."""
    layout = layout or Layout.of(gaussians)
    packed = np.empty((len(gaussians), layout.width(depth)), np.uint8)

    def pack(start: int, stop: int) -> None:
        bits = _low_bits(used_words(gaussians[start:stop])[:, layout.columns], depth)
        packed[start:stop] = np.packbits(bits, axis=1)[:, : packed.shape[1]]

    in_blocks(pack, len(gaussians), BLOCK)
    return packed


def write_low_bits(
    gaussians: Gaussians, layout: Layout, parts: Iterable[tuple[int, Integers, Bytes]]
) -> Gaussians:
    """Replace low bits: each of `parts` has a depth, distinct rows [R] and their new bytes [R, B].

    Bits beyond the B bytes keep their values.
    """
    written = gaussians.detach().to("cpu").map(torch.Tensor.contiguous).map(torch.clone)
    for depth, rows, data in parts:

        def write(
            start: int, stop: int, depth: int = depth, rows: Integers = rows, data: Bytes = data
        ) -> None:
            own, mask = rows[start:stop], np.uint32((1 << depth) - 1 << 1)
            words = np.concatenate([group[own] for group in group_words(written)], axis=1)
            fields = words[:, layout.columns]
            bits = _low_bits(fields, depth)
            bits[:, : 8 * data.shape[1]] = np.unpackbits(data[start:stop], axis=1)
            low = np.packbits(bits.reshape(len(own), -1, depth), axis=2)[:, :, 0].astype(np.uint32)
            words[:, layout.columns] = fields & ~mask | low >> np.uint32(8 - depth) << np.uint32(1)
            at = 0
            for group in group_words(written):
                group[own] = words[:, at : (at := at + group.shape[1])]

        in_blocks(write, len(rows), BLOCK)
    return written.to(gaussians.device)


def used_words(gaussians: Gaussians) -> Words32:
    """[N, F] new bit patterns of log scales, quaternions, opacity logits and harmonics above degree 0."""
    return np.concatenate(list(group_words(gaussians)), axis=1)


def group_words(gaussians: Gaussians) -> Iterator[Words32]:
    """The columns [N, C] of `used_words` by group; views where possible."""
    groups = gaussians.log_scales, gaussians.quats, gaussians.opacity_logits, gaussians.sh[:, 1:]
    return map(_words, groups)


def _low_bits(fields: Words32, depth: int) -> Bits:
    """[N, F x depth] bits `depth` to 1 of fields [N, F]."""
    low = (fields >> np.uint32(1)).astype(np.uint8)
    return np.unpackbits(low[:, :, None], axis=2)[:, :, 8 - depth :].reshape(len(low), -1)


def _words(values: torch.Tensor) -> Words32:
    """[N, C] bit patterns; a view for contiguous float32 tensors on the CPU."""
    flat = values.detach().to("cpu", torch.float32).reshape(len(values), math.prod(values.shape[1:]))
    return flat.numpy().view(np.uint32)
