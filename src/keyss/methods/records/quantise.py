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
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from keyss.core.colour import OPPONENT
from keyss.core.errors import InputError
from keyss.core.gaussians import MAX_COLOUR, MAX_COORDINATE, MAX_LENGTH, MAX_LOG_SCALE, Gaussians
from keyss.methods.records import kernels
from keyss.methods.records.lines import (
    COLOUR,
    EVEN,
    HARMONIC,
    LINE,
    POSITION,
    Extent,
    Kind,
    Line,
    fitted,
    neighbourhood,
    reaching,
)
from keyss.methods.records.table import BANDS, CHROMA_FEWER, Table
from keyss.rendering.cpu.parallel import in_blocks

__all__ = ["Codec", "Line", "out_of_range", "outliers"]

Bytes = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]
Floats = npt.NDArray[np.float64]

MAX_LOGIT = 16.0  # beyond it the float32 sigmoid is exactly 0 or 1
_MAX_HARMONIC = 1e6  # beyond it a colour is black or white wherever it is drawn at all
_MIN_LENGTH = 1e-12  # of quaternions: a shorter one turns nothing
_SAMPLE = 20_000  # Gaussians that a line is fitted to
_TABLE_BYTES = 8  # one for each number of bits, 0 for a band of harmonics that is not there
_LOOKED_UP = 13  # bits of codes for which there is a table of numbers
_BLOCK = 1 << 14  # Gaussians that a thread takes at a time
_QUAT_REACH = 0.5**0.5  # of the three smaller components
_LIMITS = np.array([MAX_COORDINATE, MAX_LOG_SCALE, MAX_LOGIT, _MAX_HARMONIC], np.float32)
# Limits of what is drawn, those of single precision as it has them.
_OVERFLOW = np.array([np.float32(MAX_COORDINATE), MAX_LOG_SCALE, MAX_LENGTH, np.float32(MAX_COLOUR)])


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
        kinds, line_of = _kinds(table.sh_degree), _line_of(table.sh_degree)
        numbers = _numbers(gaussians)
        centres = _centres(numbers, kinds, line_of, ~outlier)

        def measured(start: int, stop: int) -> Floats:
            found = np.empty((len(kinds), 5))
            kernels.reaches(start, stop, *numbers, line_of, centres, outlier, found)
            return found

        parts = np.stack(in_blocks(measured, len(gaussians), _BLOCK))
        least, largest = parts[:, :, [0, 3]].min(axis=0), parts[:, :, [1, 4]].max(axis=0)
        distances = parts[:, :, 2].sum(axis=0)
        rows = np.flatnonzero(~outlier)
        sample = list(_sampled(gaussians[torch.from_numpy(rows[:: max(1, len(rows) // _SAMPLE)])]))
        bits = _bits(table)

        def fit_line(line: int, _: int) -> tuple[Line, Line]:
            inner, outer = (Extent(least[line, i], largest[line, i]) for i in range(2))
            spread = distances[line] / (len(rows) * int((line_of == line).sum()))
            values = sample[line].ravel()
            found = fitted(kinds[line], int(bits[line]), values, inner, centres[line], spread)
            return found, reaching(found, outer)

        lines, far = zip(*in_blocks(fit_line, len(kinds), 1), strict=True)
        return Codec(table, lines, far)

    def encode(self, gaussians: Gaussians) -> Bytes:
        """[N, record_bytes] the records of N Gaussians; the bits left over are zero."""
        records = np.empty((len(gaussians), self.table.record_bytes), np.uint8)
        means, scales, *others = _numbers(gaussians)
        _for_all(
            gaussians,
            kernels.encode,
            *(means, scales, _array(gaussians.quats), *others),
            *(*self._arrays, outliers(gaussians), _bits(self.table), self.table.bits[2], _QUAT_REACH),
            *(_MIN_LENGTH, records),
        )
        return records

    def decode(self, records: Bytes) -> Gaussians:
        """The Gaussians of records [N, record_bytes]: finite float32, whatever bytes they are."""
        count, bits = len(records), _bits(self.table)
        shapes = ((3,), (3,), (4,), (), ((self.table.sh_degree + 1) ** 2, 3))
        means, scales, quats, opacities, sh = (np.empty((count, *shape), np.float32) for shape in shapes)
        tables, begins, size = [np.zeros(0)], np.full(len(bits), -1), 0
        for line, each in enumerate(bits.tolist()):
            if each <= _LOOKED_UP:
                codes = np.arange(1 << each, dtype=np.uint32)
                tables += [self.lines[line].decode(codes, each), self.far[line].decode(codes, each)]
                begins[line], size = size, size + 2 * len(codes)
        looked_up = (np.concatenate(tables), begins, bits, self.table.bits[2], _QUAT_REACH, OPPONENT)
        tensors = (means, scales, quats, opacities, sh)
        rows = np.ascontiguousarray(records)
        in_blocks(
            lambda start, stop: kernels.decode(start, stop, rows, *self._arrays, *looked_up, *tensors),
            count,
            _BLOCK,
        )
        return Gaussians(*(torch.from_numpy(each) for each in (means, quats, scales, opacities, sh)))

    @property
    def _arrays(self) -> tuple[npt.NDArray[np.int64], Floats, Floats]:
        """The line of each number, the lines and the reaches of outliers, for kernels."""
        lines = np.array([[line.centre, line.spread, line.reach] for line in self.lines])
        return _line_of(self.table.sh_degree), lines, np.array([line.reach for line in self.far])

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


def outliers(gaussians: Gaussians) -> Mask:
    """[N] which Gaussians have a number far outside of the bulk; none where that would be all."""
    sample = _sampled(gaussians[:: max(1, len(gaussians) // _SAMPLE)])
    kinds = _kinds(gaussians.sh_degree)
    ends = np.array([neighbourhood(values, kind) for values, kind in zip(sample, kinds, strict=True)])
    least, largest = ends.T[:, _line_of(gaussians.sh_degree)]
    found = np.empty(len(gaussians), bool)
    _for_all(gaussians, kernels.beyond, *_numbers(gaussians), least, largest, found)
    return found if not found.all() else ~found


def out_of_range(gaussians: Gaussians) -> int:
    """How many Gaussians have a number that a record cannot hold, and that nothing drawn depends on."""
    beyond = gaussians.overflow | (gaussians.log_scales < -MAX_LOG_SCALE).any(1)
    return int((beyond | (gaussians.sh.abs() > _MAX_HARMONIC).flatten(1).any(1)).sum())


def _centres(
    numbers: tuple[Any, ...], kinds: Sequence[Kind], line_of: npt.NDArray[np.int64], counted: Mask
) -> Floats:
    """[L] the median of each line that has a centre of its own, of the `counted` [N] Gaussians; else 0."""
    means, scales, opacities, sh, *others = numbers
    constant = np.ascontiguousarray(sh[:, :1])  # the lines in question are those of positions and colours
    numbers = (means, scales, opacities, constant, *others)

    def centre(line: int, _: int) -> float:
        if kinds[line].even or kinds[line].centred:
            return 0.0
        chosen = np.flatnonzero(line_of == line)
        values = np.empty((len(chosen), len(means)))
        kernels.numbers_of(0, len(means), *numbers, chosen, values)
        return float(np.median(values[:, counted], overwrite_input=True))

    return np.array(in_blocks(centre, len(kinds), 1))


def _kinds(sh_degree: int) -> list[Kind]:
    """What suits each line: x, y, z, log scales, opacity logits; two per band, the constant one first."""
    return [POSITION] * 3 + [EVEN] * 2 + [COLOUR] * 2 + [HARMONIC] * 2 * sh_degree


def _bits(table: Table) -> npt.NDArray[np.int64]:
    """[L] of the codes of each line."""
    means, log_scales, _, opacity, *colours = table.bits
    harmonics = [bits - fewer for bits in colours for fewer in (0, CHROMA_FEWER)]
    return np.array([means, means, means, log_scales, opacity, *harmonics])


def _line_of(sh_degree: int) -> npt.NDArray[np.int64]:
    """[M] the line of each number, in the order of records."""
    counts = [each * count for count in BANDS[: sh_degree + 1] for each in (1, 2)]
    return np.repeat(np.arange(5 + len(counts)), [1, 1, 1, 3, 1, *counts])


def _numbers(gaussians: Gaussians) -> tuple[Any, ...]:
    """What kernels make numbers of: means, log scales, opacity logits, harmonics, overflow, limits, colours.

    A Gaussian that is never drawn becomes transparent, so that its numbers in the limits are not drawn
    either.
    """
    means, scales, opacities, sh = map(
        _array, (gaussians.means, gaussians.log_scales, gaussians.opacity_logits, gaussians.sh)
    )
    overflow = np.empty(len(gaussians), bool)
    _for_all(gaussians, kernels.overflow, means, scales, _array(gaussians.quats), sh, _OVERFLOW, overflow)
    return means, scales, opacities, sh, overflow, _LIMITS, OPPONENT


def _sampled(gaussians: Gaussians) -> Iterator[Floats]:
    """Of each line the numbers [N, count] of a few Gaussians."""
    line_of = _line_of(gaussians.sh_degree)
    values = np.empty((len(line_of), len(gaussians)))
    _for_all(gaussians, kernels.numbers_of, *_numbers(gaussians), np.arange(len(line_of)), values)
    return (values[line_of == line].T for line in range(line_of[-1] + 1))


def _for_all(gaussians: Gaussians, kernel: Any, *arguments: Any) -> None:
    """`kernel(start, stop, ...)` for all Gaussians, on several threads."""
    in_blocks(lambda start, stop: kernel(start, stop, *arguments), len(gaussians), _BLOCK)


def _array(values: torch.Tensor) -> npt.NDArray[np.float32]:
    array: npt.NDArray[np.float32] = values.detach().to("cpu", torch.float32).contiguous().numpy()
    return array
