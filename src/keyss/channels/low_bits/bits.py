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
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import torch

from keyss.channels.low_bits import hashing, kernels
from keyss.core.gaussians import Gaussians
from keyss.rendering.cpu.parallel import in_blocks

FIELDS = ("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3", "opacity")
GEOMETRY = kernels.GEOMETRY  # fields of a Gaussian before the spherical harmonics
QUATS = slice(3, 7)  # of these
GEOMETRY_BITS, SH_BITS = 8, 12
UNUSED_BITS = 1  # below them
UNIT_TOLERANCE = 1e-4  # of a length that is known without the low bits, to 2e-5 on average

KERNEL_BLOCK = 1 << 14  # Gaussians that a thread takes at a time
_BLOCK = 1 << 16  # Gaussians at a time
_WRITTEN = 1 << 11  # the same where they should stay in the cache

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
        quats, deviation = _words(gaussians.quats), np.empty(len(gaussians))

        def measure(start: int, stop: int) -> None:
            deviation[start:stop] = np.abs(coarse_lengths(quats[start:stop]) - 1)

        in_blocks(measure, len(gaussians), KERNEL_BLOCK)
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

    @property
    def shifts(self) -> Words:
        """[F] by which a word is shifted so that the bits in use, and those below them, are gone."""
        return np.array([int(each).bit_length() for each in self.mask], np.uint32)


def bytes_per_gaussian(sh_degree: int) -> int:
    """Bytes of one Gaussian's low bits, quaternions included: 8, 21, 44 and 75 at degrees 0 to 3."""
    return Layout(sh_degree).width


def coarse_lengths(quats: Words) -> npt.NDArray[np.float64]:
    """[N] of quaternions [N, 4] with the middle of all low bits that they could have."""
    low = np.uint32((1 << UNUSED_BITS + GEOMETRY_BITS) - 1)
    with np.errstate(over="ignore", invalid="ignore"):
        middle = (quats & ~low | (low + 1) >> 1).view(np.float32).astype(np.float64)
        lengths: npt.NDArray[np.float64] = np.sqrt((middle * middle).sum(axis=1))
    return lengths


def identities(gaussians: Gaussians, layout: Layout | None = None) -> Bytes:
    """[N, 16] for each Gaussian a public hash (BLAKE2b) of all that embedding leaves as it is."""
    words, mask = words_of(gaussians), (layout or Layout.of(gaussians)).mask
    hashes = np.empty((len(gaussians), 2), np.uint64)
    in_blocks(
        lambda start, stop: hashing.identify(start, stop, *words, mask, hashes), len(gaussians), KERNEL_BLOCK
    )
    return hashes.view(np.uint8)


def read_low_bits(gaussians: Gaussians, layout: Layout | None = None) -> Bytes:
    """[N, B] the low bits of each Gaussian as bytes, as many as its `Layout` is wide."""
    layout = layout or Layout.of(gaussians)
    _, *fields = words_of(gaussians)
    low = np.empty((len(gaussians), layout.width), np.uint8)
    in_blocks(
        lambda start, stop: kernels.pack(start, stop, *fields, layout.quats, low),
        len(gaussians),
        KERNEL_BLOCK,
    )
    return low


def write_low_bits(gaussians: Gaussians, rows: npt.NDArray[np.int64], data: Bytes) -> Gaussians:
    """The same Gaussians with other low bits [R, B] in the `rows` [R], which are different ones.

    Where a Gaussian's bits are no whole number of bytes, the last half byte stays as it is.
    """
    return with_low_bits(gaussians, Layout.of(gaussians), [(rows, data)])


def with_low_bits(
    gaussians: Gaussians, layout: Layout, parts: Iterable[tuple[npt.NDArray[np.int64], Bytes]]
) -> Gaussians:
    """`write_low_bits` for several (rows, data)."""
    source = gaussians.detach().to("cpu").map(torch.Tensor.contiguous)
    written = replace(source.map(torch.empty_like), means=source.means)
    before, after = words_of(source)[1:], words_of(written)[1:]
    choices = []
    for rows, data in parts:  # each Gaussian has more lines in the cache than its bits
        chosen = np.full(len(gaussians), -1, np.int64)
        chosen[rows] = np.arange(len(rows))
        choices.append((chosen, data))

    def write(start: int, stop: int) -> None:
        for old, new in zip(before, after, strict=True):
            new[start:stop] = old[start:stop]
        for chosen, data in choices:
            kernels.unpack(start, stop, chosen, data, *after, layout.quats)

    in_blocks(write, len(gaussians), _WRITTEN)
    return written.to(gaussians.device)


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


def words_of(gaussians: Gaussians) -> tuple[Words, Words, Words, Words, Words]:
    """Bit patterns of means [N, 3], log scales [N, 3], quaternions [N, 4], opacity logits [N], and harmonics
    [N, 3 K], for `kernels`: the model's own memory where it is contiguous and on the CPU.
    """
    return (
        _words(gaussians.means),
        _words(gaussians.log_scales),
        _words(gaussians.quats),
        _words(gaussians.opacity_logits)[:, 0],
        _words(gaussians.sh),
    )


def _words(values: torch.Tensor) -> Words:
    width = math.prod(values.shape[1:])
    flat = values.detach().to("cpu", torch.float32).reshape(len(values), width).contiguous()
    return flat.numpy().view(np.uint32)
