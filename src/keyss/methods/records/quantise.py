"""Gaussians as records of a fixed number of bits, and back.

A record holds everything that renders: position, log scales, opacity logit, direction of the quaternion
(its length means nothing), colour and spherical harmonics. Numbers go through a `Line`, divided evenly:

- log scales and opacity logits as they are, between the extremes that occur;
- positions, colours and harmonics as asinh((value - centre) / spread): fine where most are, coarse in
  proportion to the distance further out. Positions reach to the furthest one; of the others the few furthest
  may be clipped, whichever gives the least mean square error;
- of three colours their brightness and two differences, which are small, on a line of their own;
- of a quaternion the three smallest components, of which none is above sqrt(1/2), and which is left out.

Lines are fitted to the bulk. A Gaussian with a number far outside of it is an *outlier*: one bit of its
record says so, and its numbers go through the same lines with a longer reach. So outliers cost the bulk
nothing but that bit, whatever their numbers are. Numbers so large that nothing is drawn, or nothing else, are
clamped.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from keyss.core.colour import OPPONENT
from keyss.core.errors import InputError
from keyss.core.gaussians import MAX_COORDINATE, MAX_LOG_SCALE, Gaussians
from keyss.methods.records.lines import (
    COLOUR,
    EVEN,
    HARMONIC,
    LINE,
    POSITION,
    Codes,
    Extent,
    Floats,
    Kind,
    Line,
    fitted,
    neighbourhood,
    reaching,
)
from keyss.methods.records.packing import Bytes, codes_of_records, records_of_codes
from keyss.methods.records.table import BANDS, CHROMA_FEWER, Table
from keyss.rendering.cpu.parallel import in_blocks

Mask = npt.NDArray[np.bool_]

MAX_LOGIT = 16.0  # beyond it the float32 sigmoid is exactly 0 or 1
_MAX_HARMONIC = 1e6  # beyond it a colour is black or white wherever it is drawn at all
_MIN_LENGTH = 1e-12  # of quaternions: a shorter one turns nothing
_SAMPLE = 20_000  # Gaussians that a line is fitted to
_TABLE_BYTES = 8  # one for each number of bits, 0 for a band of harmonics that is not there
_QUAT_LINE = Line(0, 0, 0.5**0.5)  # of the three smaller components


@dataclass(frozen=True)
class Codec:
    """How the Gaussians of one secret are written: a table of bits, and a line for each kind of number."""

    table: Table
    lines: tuple[Line, ...]  # x, y, z, log scales, opacity logits; two per band, the constant one first
    far: tuple[Line, ...]  # the same with the reach that outliers need

    @staticmethod
    def fit(gaussians: Gaussians, table: Table) -> Codec:
        """The lines that suit `gaussians`, of which the table must have the SH degree."""
        if table.sh_degree != gaussians.sh_degree:
            raise ValueError(f"SH degree {gaussians.sh_degree}, but the table is for {table.sh_degree}")
        outlier = outliers(gaussians)
        kinds, bits, found = _kinds(table.sh_degree), _bits(table), list[_Measured]()
        for kind, values in zip(kinds, _numbers(gaussians), strict=True):
            found.append(_Measured.of(kind, values[~outlier], values[outlier]))

        def fit_line(index: int, _: int) -> tuple[Line, Line]:
            each = found[index]
            line = fitted(kinds[index], bits[index], each.sample, each.inner, each.centre, each.spread)
            return line, reaching(line, each.outer)

        lines, far = zip(*in_blocks(fit_line, len(kinds), 1), strict=True)
        return Codec(table, lines, far)

    def encode(self, gaussians: Gaussians) -> Bytes:
        """[N, record_bytes] the records of N Gaussians; the bits left over are zero."""
        outlier = outliers(gaussians)
        left_out, three = _three_smallest(_doubles(gaussians.quats))
        columns = [
            outlier[:, None].astype(np.uint32),
            left_out,
            _QUAT_LINE.encode(three, self.table.bits[2]),
        ]
        every = zip(self.lines, self.far, _bits(self.table), _numbers(gaussians), strict=True)
        for line, far, bits, values in every:
            codes = line.encode(values, bits)
            codes[outlier] = far.encode(values[outlier], bits)
            columns.append(codes)
        return records_of_codes(columns, self.table.layout)

    def decode(self, records: Bytes) -> Gaussians:
        """The Gaussians of records [N, record_bytes]: finite float32, whatever bytes they are."""
        outlier, left_out, three, *columns = codes_of_records(records, self.table.layout)
        beyond = outlier[:, 0] > 0
        numbers = []
        for line, far, bits, codes in zip(self.lines, self.far, _bits(self.table), columns, strict=True):
            values = line.decode(codes, bits)
            values[beyond] = far.decode(codes[beyond], bits)
            numbers.append(values)
        x, y, z, scales, opacities, *colours = numbers
        bands = []
        for brightness, differences in zip(colours[::2], colours[1::2], strict=True):
            pairs = differences.reshape(*brightness.shape, 2)
            bands.append(np.concatenate([brightness[:, :, None], pairs], axis=2) @ OPPONENT)
        quats = _whole_quats(left_out, _QUAT_LINE.decode(three, self.table.bits[2]))
        tensors = (np.concatenate([x, y, z], 1), quats, scales, opacities[:, 0], np.concatenate(bands, 1))
        return Gaussians(*(torch.from_numpy(each.astype(np.float32)) for each in tensors))

    def pack(self) -> bytes:
        """The codec itself: 92 to 164 bytes."""
        numbers = b"".join(
            LINE.pack(line.centre, line.spread, line.reach, far.reach)
            for line, far in zip(self.lines, self.far, strict=True)
        )
        return bytes(self.table.bits).ljust(_TABLE_BYTES, b"\0") + numbers

    @staticmethod
    def packed_size(sh_degree: int) -> int:
        """Bytes of a packed codec for secrets of this SH degree."""
        return _TABLE_BYTES + LINE.size * (7 + 2 * sh_degree)

    @staticmethod
    def unpack(data: bytes) -> Codec:
        """The codec of `pack`; what follows it is ignored. Raises InputError for anything else."""
        try:
            table = Table(tuple(data[:_TABLE_BYTES].rstrip(b"\0")))
            numbers = data[_TABLE_BYTES : Codec.packed_size(table.sh_degree)]
            unpacked = list(LINE.iter_unpack(numbers))
            lines = tuple(Line(centre, spread, reach) for centre, spread, reach, _ in unpacked)
            far = tuple(Line(centre, spread, reach) for centre, spread, _, reach in unpacked)
        except (ValueError, struct.error) as error:
            raise InputError(f"the hidden parameters are damaged: {error}") from error
        if len(lines) != 7 + 2 * table.sh_degree:
            raise InputError("the hidden parameters are damaged: they are too short")
        return Codec(table, lines, far)


@dataclass(frozen=True)
class _Measured:
    """What a line is fitted to."""

    sample: Floats  # of numbers that are no outliers'
    inner: Extent  # of all of these
    outer: Extent  # of outliers'
    centre: float
    spread: float  # mean distance from the centre

    @staticmethod
    def of(kind: Kind, values: Floats, outlying: Floats) -> _Measured:
        centre = 0.0 if kind.even or kind.centred else float(np.median(values))
        spread = float(np.abs(values - centre).mean())
        sample = values[:: max(1, len(values) // _SAMPLE)].ravel()
        return _Measured(sample, Extent.of(values), Extent.of(outlying), centre, spread)


def outliers(gaussians: Gaussians) -> Mask:
    """[N] which Gaussians have a number far outside of the bulk; none where that would be all."""
    found, every = np.zeros(len(gaussians), bool), max(1, len(gaussians) // _SAMPLE)
    for kind, values in zip(_kinds(gaussians.sh_degree), _numbers(gaussians), strict=True):
        least, largest = neighbourhood(values[::every], kind)
        found |= ((values < least) | (values > largest)).any(axis=1)
    return found if not found.all() else ~found


def out_of_range(gaussians: Gaussians) -> int:
    """How many Gaussians have a number that a record cannot hold, and that nothing drawn depends on."""
    beyond = gaussians.overflow | (gaussians.log_scales < -MAX_LOG_SCALE).any(1)
    return int((beyond | (gaussians.sh.abs() > _MAX_HARMONIC).flatten(1).any(1)).sum())


def _kinds(sh_degree: int) -> list[Kind]:
    """What suits each line: x, y, z, log scales, opacity logits; two per band, the constant one first."""
    return [POSITION] * 3 + [EVEN] * 2 + [COLOUR] * 2 + [HARMONIC] * 2 * sh_degree


def _bits(table: Table) -> list[int]:
    """Of the codes of each line."""
    means, log_scales, _, opacity, *colours = table.bits
    harmonics = [bits - fewer for bits in colours for fewer in (0, CHROMA_FEWER)]
    return [means, means, means, log_scales, opacity, *harmonics]


def _numbers(gaussians: Gaussians) -> Iterator[Floats]:
    """[N, count] the numbers of each line.

    A Gaussian that is never drawn becomes transparent, so that its numbers in the limits are not drawn
    either.
    """
    positions = _doubles(gaussians.means.clamp(-MAX_COORDINATE, MAX_COORDINATE))
    yield from np.split(positions, 3, axis=1)
    yield _doubles(gaussians.log_scales.clamp(-MAX_LOG_SCALE, MAX_LOG_SCALE))
    logits = gaussians.opacity_logits.masked_fill(gaussians.overflow, -MAX_LOGIT)
    yield _doubles(logits.clamp(-MAX_LOGIT, MAX_LOGIT))[:, None]
    first = 0
    for count in BANDS[: gaussians.sh_degree + 1]:
        harmonics = gaussians.sh[:, first : first + count].clamp(-_MAX_HARMONIC, _MAX_HARMONIC)
        rotated = _doubles(harmonics) @ OPPONENT.T
        yield rotated[:, :, 0]
        yield rotated[:, :, 1:].reshape(len(rotated), -1)
        first += count


def _three_smallest(quats: Floats) -> tuple[Codes, Floats]:
    """[N, 1] which component is the largest, and [N, 3] the others, of the unit quaternion with it > 0."""
    length = np.linalg.norm(quats, axis=1, keepdims=True)
    turned = length > _MIN_LENGTH
    unit = np.where(turned, quats / np.where(turned, length, 1), [1.0, 0, 0, 0])
    largest = np.abs(unit).argmax(axis=1)[:, None]
    unit = unit * np.where(np.take_along_axis(unit, largest, 1) < 0, -1.0, 1.0)
    others = np.arange(3) + (np.arange(3) >= largest)
    return largest.astype(np.uint32), np.take_along_axis(unit, others, 1)


def _whole_quats(largest: Codes, three: Floats) -> Floats:
    """[N, 4] unit quaternions; codes that no quaternion has give one too."""
    index = largest.astype(np.int64)
    quats = np.empty((len(three), 4))
    np.put_along_axis(quats, np.arange(3) + (np.arange(3) >= index), three, 1)
    rest = np.sqrt((1 - np.square(three).sum(axis=1, keepdims=True)).clip(0))
    np.put_along_axis(quats, index, rest, 1)
    quats /= np.linalg.norm(quats, axis=1, keepdims=True).clip(0.5)
    return quats


def _doubles(values: torch.Tensor) -> Floats:
    return values.detach().cpu().numpy().astype(np.float64)
