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
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from keyss.core.colour import OPPONENT
from keyss.core.errors import InputError
from keyss.core.gaussians import MAX_COORDINATE, MAX_LOG_SCALE, Gaussians
from keyss.methods.records.packing import CHUNK, packed
from keyss.methods.records.table import BANDS, CHROMA_FEWER, Table

Floats = npt.NDArray[np.float64]
Codes = npt.NDArray[np.uint32]
Bytes = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]

MAX_LOGIT = 16.0  # beyond it the float32 sigmoid is exactly 0 or 1
_MAX_HARMONIC = 1e6  # beyond it a colour is black or white wherever it is drawn at all
_MIN_LENGTH = 1e-12  # of quaternions: a shorter one turns nothing
_TAIL = 0.05  # share of the numbers that says nothing of how far the bulk reaches, on each side if both count
_EVEN_MARGIN = 0.75  # on a line divided evenly the bulk's neighbourhood ends as many of its widths from it
_FAR = 8.0  # on one by asinh it ends at as many times the bulk's distance from the median
_FURTHEST = 1e30  # no value that a line may give is larger
_LEAST_SPREAD = 1e-9
_HALF = 1e-3  # half precision rounds by less than this share
_SAMPLE = 20_000  # Gaussians that a line is fitted to
_LINE = struct.Struct("<2f2e")
_TABLE_BYTES = 8  # one for each number of bits, 0 for a band of harmonics that is not there
# The line with the least square error makes numbers smaller on average, which costs more against photos than
# errors that are independent of the numbers: this part of the error counts so much more.
_SHRINKING_WEIGHT = 20.0


@dataclass(frozen=True)
class Line:
    """Codes 0 .. 2^bits - 1 for real numbers, between centre - reach and centre + reach of the line."""

    centre: float
    spread: float  # 0: the numbers as they are; else asinh of their distance from the centre in spreads
    reach: float  # of the number, or of its asinh

    def __post_init__(self) -> None:
        """Raise ValueError unless every code stands for a number of bounded size."""
        if not (abs(self.centre) < _FURTHEST and 0 <= self.spread < _FURTHEST and 0 < self.reach < _FURTHEST):
            raise ValueError(f"no such line: {self}")
        if self.spread > 0 and (self.reach > 60 or self.spread * np.sinh(self.reach) > _FURTHEST):
            raise ValueError(f"no such line: {self}")

    def encode(self, values: Floats, bits: int) -> Codes:
        """Of each value the nearest code; of those beyond the ends the last one."""
        offset: Floats = values - self.centre
        position: Floats = np.arcsinh(offset / self.spread) if self.spread > 0 else offset
        last = (1 << bits) - 1
        codes = np.rint((position / self.reach + 1) * (last / 2)).clip(0, last)
        return codes.astype(np.uint32)

    def decode(self, codes: Codes, bits: int) -> Floats:
        """The values that codes stand for."""
        position = (codes.astype(np.float64) * (2 / ((1 << bits) - 1)) - 1) * self.reach
        offset: Floats = np.sinh(position) * self.spread if self.spread > 0 else position
        return offset + self.centre


_QUAT_LINE = Line(0, 0, 0.5**0.5)


class _Kind(NamedTuple):
    """What suits the numbers of one kind."""

    even: bool = False  # whether their line is divided evenly, else by asinh
    clips: bool = False  # whether the furthest of the bulk may be clipped
    centred: bool = False  # whether zero is the centre


_EVEN, _POSITION = _Kind(even=True), _Kind()
_COLOUR, _HARMONIC = _Kind(clips=True), _Kind(clips=True, centred=True)


class _Numbers(NamedTuple):
    """Numbers of N Gaussians that share a line."""

    values: Floats  # [N, count]
    bits: int
    kind: _Kind


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
        lines, far = [], []
        for numbers in _numbers(gaussians, table):
            lines.append(_fitted(numbers._replace(values=numbers.values[~outlier])))
            far.append(_reaching(lines[-1], numbers.values[outlier]))
        return Codec(table, tuple(lines), tuple(far))

    def encode(self, gaussians: Gaussians) -> Bytes:
        """[N, record_bytes] the records of N Gaussians; the bits left over are zero."""
        records = np.empty((len(gaussians), self.table.record_bytes), np.uint8)
        outlier = outliers(gaussians)
        for start in range(0, len(gaussians), CHUNK):
            part = slice(start, start + CHUNK)
            records[part] = packed(self._codes(gaussians[part], outlier[part]))
        return records

    def decode(self, records: Bytes) -> Gaussians:
        """The Gaussians of records [N, record_bytes]: finite float32, whatever bytes they are."""
        starts = range(0, max(len(records), 1), CHUNK)
        return Gaussians.cat([self._values(records[start : start + CHUNK]) for start in starts])

    def pack(self) -> bytes:
        """The codec itself: 92 to 164 bytes."""
        numbers = b"".join(
            _LINE.pack(line.centre, line.spread, line.reach, far.reach)
            for line, far in zip(self.lines, self.far, strict=True)
        )
        return bytes(self.table.bits).ljust(_TABLE_BYTES, b"\0") + numbers

    @staticmethod
    def packed_size(sh_degree: int) -> int:
        """Bytes of a packed codec for secrets of this SH degree."""
        return _TABLE_BYTES + _LINE.size * (7 + 2 * sh_degree)

    @staticmethod
    def unpack(data: bytes) -> Codec:
        """The codec of `pack`; what follows it is ignored. Raises InputError for anything else."""
        try:
            table = Table(tuple(data[:_TABLE_BYTES].rstrip(b"\0")))
            numbers = data[_TABLE_BYTES : Codec.packed_size(table.sh_degree)]
            unpacked = list(_LINE.iter_unpack(numbers))
            lines = tuple(Line(centre, spread, reach) for centre, spread, reach, _ in unpacked)
            far = tuple(Line(centre, spread, reach) for centre, spread, _, reach in unpacked)
        except (ValueError, struct.error) as error:
            raise InputError(f"the hidden parameters are damaged: {error}") from error
        if len(lines) != 7 + 2 * table.sh_degree:
            raise InputError("the hidden parameters are damaged: they are too short")
        return Codec(table, lines, far)

    def _codes(self, gaussians: Gaussians, outlier: Mask) -> Iterator[tuple[Codes, int]]:
        """Columns of codes and the bits of each."""
        yield outlier[:, None].astype(np.uint32), 1
        left_out, three = _three_smallest(_doubles(gaussians.quats))
        yield left_out, 2
        yield _QUAT_LINE.encode(three, self.table.bits[2]), self.table.bits[2]
        numbers = _numbers(gaussians, self.table)
        for line, far, (values, bits, _) in zip(self.lines, self.far, numbers, strict=True):
            codes = line.encode(values, bits)
            codes[outlier] = far.encode(values[outlier], bits)
            yield codes, bits

    def _values(self, records: Bytes) -> Gaussians:
        means, log_scales, quats, opacity, *colours = self.table.bits
        lines = iter(zip(self.lines, self.far, strict=True))
        unread = np.unpackbits(records, axis=1)

        def codes(columns: int, bits: int) -> Codes:
            """[N, columns] the next codes, in the order in which they were packed."""
            nonlocal unread
            part, unread = np.split(unread, [columns * bits], axis=1)
            powers = np.uint32(1) << np.arange(bits, dtype=np.uint32)[::-1]
            return part.reshape(-1, columns, bits) @ powers

        outlier = codes(1, 1)[:, 0] > 0

        def values(columns: int, bits: int) -> Floats:
            (line, far), read = next(lines), codes(columns, bits)
            found = line.decode(read, bits)
            found[outlier] = far.decode(read[outlier], bits)
            return found

        left_out = codes(1, 2)
        turns = _whole_quats(left_out, _QUAT_LINE.decode(codes(3, quats), quats))
        positions = np.concatenate([values(1, means) for _ in range(3)], axis=1)
        sizes, logits = values(3, log_scales), values(1, opacity)[:, 0]
        harmonics = []
        for count, bits in zip(BANDS, colours, strict=False):
            brightness = values(count, bits)[:, :, None]
            differences = values(2 * count, bits - CHROMA_FEWER).reshape(-1, count, 2)
            harmonics.append(np.concatenate([brightness, differences], axis=2) @ OPPONENT)
        sh = np.concatenate(harmonics, axis=1)
        return Gaussians(*(torch.from_numpy(v).float() for v in (positions, turns, sizes, logits, sh)))


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
    """[N, 4] unit quaternions; codes that no quaternion has give one all the same."""
    index = largest.astype(np.int64)
    quats = np.empty((len(three), 4))
    np.put_along_axis(quats, np.arange(3) + (np.arange(3) >= index), three, 1)
    rest = np.sqrt((1 - np.square(three).sum(axis=1, keepdims=True)).clip(0))
    np.put_along_axis(quats, index, rest, 1)
    quats /= np.linalg.norm(quats, axis=1, keepdims=True).clip(0.5)
    return quats


def outliers(gaussians: Gaussians) -> Mask:
    """[N] which Gaussians have a number far outside of the bulk; none where that would be all."""
    found = np.zeros(len(gaussians), bool)
    for values, _, kind in _numbers(gaussians, Table.floor(gaussians.sh_degree)):
        low, high = _neighbourhood(_sample(values), kind)
        found |= ((values < low) | (values > high)).any(axis=1)
    return found if not found.all() else ~found


def _neighbourhood(values: Floats, kind: _Kind) -> tuple[float, float]:
    """The ends of what is not far outside of the bulk of `values`.

    Quantiles tell how far the bulk reaches. Fewer than `_TAIL` of the values, whatever they are, cannot move
    these beyond the others. So they make a line that is divided evenly at most 2.5 times (the bulk and two
    margins) as long as the others alone need, and each number as much less precise.
    """
    if kind.even:
        low = float(np.quantile(values, _TAIL, method="higher"))
        high = float(np.quantile(values, 1 - _TAIL, method="lower"))
        margin = _EVEN_MARGIN * (high - low)
        return low - margin, high + margin
    centre = float(np.median(values))
    reach = _FAR * float(np.quantile(np.abs(values - centre), 1 - _TAIL, method="lower"))
    return centre - reach, centre + reach


def out_of_range(gaussians: Gaussians) -> int:
    """How many Gaussians have a number that a record cannot hold, and that nothing drawn depends on."""
    beyond = gaussians.overflow | (gaussians.log_scales < -MAX_LOG_SCALE).any(1)
    return int((beyond | (gaussians.sh.abs() > _MAX_HARMONIC).flatten(1).any(1)).sum())


def _fitted(numbers: _Numbers) -> Line:
    """The line for the numbers of the bulk."""
    values, bits, kind = numbers
    if kind.even:
        low, high = float(values.min()), float(values.max())
        return _line((low + high) / 2, 0, (high - low) / 2)
    if kind.clips:
        return _best_line(values, bits, kind.centred)
    centre = float(np.median(values))
    spread = _spread(values - centre)
    return _reaching(_line(centre, spread, 1), values)


def _reaching(line: Line, values: Floats) -> Line:
    """`line` with such a reach that all values lie on it."""
    furthest = float(np.abs(values - line.centre).max(initial=0))
    reach = np.arcsinh(furthest / line.spread) if line.spread > 0 else furthest
    return _line(line.centre, line.spread, float(reach))


def _best_line(values: Floats, bits: int, centred: bool) -> Line:
    """Of some lines that reach to the furthest value or less far the one with the least error."""
    sample = _sample(values).ravel()
    centre = 0.0 if centred else float(np.median(values))
    spread = _spread(values - centre)
    furthest = float(np.abs(values - centre).max()) or 1.0
    best, least = _line(centre, spread, float(np.arcsinh(furthest / spread))), np.inf
    for scale in (0.5, 1.0, 2.0, 4.0):
        for reach in np.geomspace(min(0.5 * spread, furthest), furthest, 12):
            line = _line(centre, scale * spread, float(np.arcsinh(reach / (scale * spread))))
            error = line.decode(line.encode(sample, bits), bits) - sample
            shrinking = float((error * (sample - centre)).mean()) ** 2 / spread**2
            cost = float(np.square(error).mean()) + _SHRINKING_WEIGHT * shrinking
            if cost < least:
                best, least = line, cost
    return best


def _spread(offsets: Floats) -> float:
    return max(float(np.abs(offsets).mean()), _LEAST_SPREAD)


def _line(centre: float, spread: float, reach: float) -> Line:
    """A line whose numbers are as precise as they are stored, and that is longer than a point."""
    return Line(*_LINE.unpack(_LINE.pack(centre, spread, max(reach * (1 + _HALF), _HALF), 0))[:3])


def _sample(values: Floats) -> Floats:
    """Some of the rows of `values`."""
    return values[:: max(1, len(values) // _SAMPLE)]


def _numbers(gaussians: Gaussians, table: Table) -> Iterator[_Numbers]:
    """All numbers but the quaternions, those of each line together, in the order in which they are stored.

    A Gaussian that is never drawn becomes transparent, so that its numbers in the limits are not drawn
    either.
    """
    means, log_scales, _, opacity, *colours = table.bits
    positions = _doubles(gaussians.means.clamp(-MAX_COORDINATE, MAX_COORDINATE))
    for axis in range(3):
        yield _Numbers(positions[:, axis : axis + 1], means, _POSITION)
    sizes = _doubles(gaussians.log_scales.clamp(-MAX_LOG_SCALE, MAX_LOG_SCALE))
    yield _Numbers(sizes, log_scales, _EVEN)
    logits = gaussians.opacity_logits.masked_fill(gaussians.overflow, -MAX_LOGIT)
    yield _Numbers(_doubles(logits.clamp(-MAX_LOGIT, MAX_LOGIT))[:, None], opacity, _EVEN)
    for band, bits in enumerate(colours):
        harmonics = gaussians.sh[:, band**2 : (band + 1) ** 2].clamp(-_MAX_HARMONIC, _MAX_HARMONIC)
        rotated, kind = _doubles(harmonics) @ OPPONENT.T, _HARMONIC if band > 0 else _COLOUR
        yield _Numbers(rotated[:, :, 0], bits, kind)
        yield _Numbers(rotated[:, :, 1:].reshape(len(rotated), -1), bits - CHROMA_FEWER, kind)


def _doubles(values: torch.Tensor) -> Floats:
    return values.detach().cpu().numpy().astype(np.float64)
