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
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from keyss.core.arrays import Bytes, Doubles, Integers, Words32
from keyss.core.gaussians import Gaussians
from keyss.kernels.blake2b import blake2b_rows
from keyss.kernels.jit import kernel
from keyss.kernels.parallel import in_blocks

ATTRIBUTES = SCALES, QUATS, OPACITIES, HARMONICS = "log scales", "quaternions", "opacity logits", "harmonics"
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
        words = bit_patterns(gaussians.quats)
        lengths = in_blocks(lambda start, stop: coarse_lengths(words[start:stop]), len(words), BLOCK)
        away = float(np.median(np.abs(np.concatenate(lengths) - 1))) if lengths else 1.0
        return Layout(gaussians.sh_degree, away > UNIT_TOLERANCE)

    def width(self, depth: int) -> int:
        """Whole bytes in the low bits of one Gaussian: at depth 8 one for each field in use."""
        return len(self.columns) * depth // 8

    @property
    def columns(self) -> Integers:
        """[F'] the columns of `used_words` in use."""
        every = np.arange(8 + 3 * ((self.sh_degree + 1) ** 2 - 1))
        return every if self.quats else np.delete(every, slice(3, 7))

    def groups(self, gaussians: Gaussians) -> dict[str, Words32]:
        """[N, C] bit patterns in use by attribute; views where possible."""
        every = dict(zip(ATTRIBUTES, group_words(gaussians), strict=True))
        return every if self.quats else {name: every[name] for name in every if name != QUATS}


def coarse_lengths(quats: Words32) -> Doubles:
    """[N] lengths of quaternions [N, 4] whose low bits are replaced by the middle of their range."""
    with np.errstate(over="ignore", invalid="ignore"):
        middle = (quats & ~LOW | (LOW + 1) >> 1).view(np.float32).astype(np.float64)
        lengths: Doubles = np.sqrt((middle * middle).sum(axis=1))
    return lengths


def gaussian_ids(gaussians: Gaussians, layout: Layout | None = None) -> Bytes:
    """[N, 16] IDs of the Gaussians: public hashes (BLAKE2b) of the bits that embedding never changes."""
    columns = (layout or Layout.of(gaussians)).columns
    stays = np.full(8 + 3 * gaussians.sh.shape[1], ~np.uint32(0))  # masks of unchanged bits
    stays[3 + columns] = ~LOW | np.uint32(1)

    def ids(start: int, stop: int) -> Bytes:
        block = gaussians[start:stop]
        words = np.concatenate([bit_patterns(block.means), *group_words(block)], axis=1)
        words &= stays
        return blake2b_rows(words, _PERSON)

    return np.concatenate([np.zeros((0, ID_BYTES), np.uint8), *in_blocks(ids, len(gaussians), BLOCK)])


def read_low_bits(gaussians: Gaussians, depth: int = DEEPEST, layout: Layout | None = None) -> Bytes:
    """[N, B] the low bits of each Gaussian, field after field, the highest bit first; B = `layout.width`."""
    layout = layout or Layout.of(gaussians)
    packed, columns = np.empty((len(gaussians), layout.width(depth)), np.uint8), layout.columns

    def pack(start: int, stop: int) -> None:
        _pack(used_words(gaussians[start:stop]), columns, depth, packed[start:stop])

    in_blocks(pack, len(gaussians), BLOCK, _pack)
    return packed


def write_low_bits(
    gaussians: Gaussians, layout: Layout, parts: Iterable[tuple[int, Integers, Bytes]]
) -> Gaussians:
    """Replace low bits: each of `parts` has a depth, distinct rows [R] and their new bytes [R, B].

    Bits beyond the B bytes keep their values.
    """
    written = gaussians.detach().to("cpu").map(torch.Tensor.contiguous).map(torch.clone)
    groups, columns = group_words(written), layout.columns
    for depth, rows, data in parts:

        def write(
            start: int, stop: int, depth: int = depth, rows: Integers = rows, data: Bytes = data
        ) -> None:
            block = rows[start:stop]
            words, at = np.concatenate([group[block] for group in groups], axis=1), 0
            _unpack(words, columns, depth, data[start:stop].copy())
            for group in groups:
                group[block] = words[:, at : (at := at + group.shape[1])]

        in_blocks(write, len(rows), BLOCK, _unpack)
    return written.to(gaussians.device)


def used_words(gaussians: Gaussians) -> Words32:
    """[N, F] new bit patterns of log scales, quaternions, opacity logits and harmonics above degree 0."""
    return np.concatenate(group_words(gaussians), axis=1)


def group_words(gaussians: Gaussians) -> list[Words32]:
    """The columns [N, C] of `used_words` by attribute; views where possible."""
    attributes = gaussians.log_scales, gaussians.quats, gaussians.opacity_logits, gaussians.sh[:, 1:]
    return [bit_patterns(values) for values in attributes]


def exponents(words: Words32) -> Bytes:
    """[...] the biased binary exponents."""
    return (words >> np.uint32(23) & np.uint32(255)).astype(np.uint8)


@kernel
def _pack(words: Any, columns: Any, depth: int, packed: Any) -> None:
    """Set `packed` [N, B] to the low bits of the `columns` of words [N, F]; see `read_low_bits`."""
    mask = (1 << depth) - 1
    for row in range(len(words)):
        bits: Any = 0
        held, at = 0, 0  # bits that are not packed yet, bytes
        for column in columns:
            bits = bits << depth | np.int64(words[row, column] >> np.uint32(1)) & mask
            held += depth
            if held >= 8:
                held -= 8
                packed[row, at] = bits >> held
                at += 1
                bits &= (1 << held) - 1


@kernel
def _unpack(words: Any, columns: Any, depth: int, data: Any) -> None:
    """Replace low bits of the `columns` of words [R, F] by `data` [R, B]; see `write_low_bits`."""
    for row in range(len(words)):
        bits: Any = 0
        held, at = 0, 0  # bits that are not written yet, bytes
        for column in columns:
            if held < depth and at < data.shape[1]:
                bits = bits << 8 | np.int64(data[row, at])
                held += 8
                at += 1
            count = min(held, depth)  # fewer than `depth` only at the end of the data
            held -= count
            new = bits >> held << (depth - count + 1)
            mask = ((1 << count) - 1) << (depth - count + 1)
            words[row, column] = np.uint32(words[row, column] & ~mask | new)
            bits &= (1 << held) - 1


def bit_patterns(values: torch.Tensor) -> Words32:
    """[N, C] bit patterns; a view for contiguous float32 tensors on the CPU."""
    words = values.detach().to("cpu", torch.float32).numpy().view(np.uint32)
    return words.reshape(len(values), math.prod(values.shape[1:]))
