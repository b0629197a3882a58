"""Gaussians as records of a fixed number of bits, and back.

A record holds everything that renders: position, log scales, opacity logit, direction of the quaternion
(its length means nothing), colour and spherical harmonics. Numbers go through a `Line`, divided evenly:

- log scales and opacity logits as they are, between the extremes that occur;
- positions, colours and harmonics as asinh((value - centre) / spread): fine where most are, coarse in
  proportion to the distance further out. Positions reach to the furthest one; of the others the few furthest
  may be clipped, whichever gives the least mean square error;
- of three colours their brightness and two differences, which are small, on a line of their own;
- of a quaternion the three smallest components, of which none is above sqrt(1/2), and which is left out.
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
from keyss.core.gaussians import Gaussians
from keyss.methods.carry.table import BANDS, CHROMA_FEWER, Table

Floats = npt.NDArray[np.float64]
Codes = npt.NDArray[np.uint32]
Bytes = npt.NDArray[np.uint8]

MAX_LOGIT = 16.0  # beyond it the float32 sigmoid is exactly 0 or 1
_FURTHEST = 1e30  # no value that a line may give is larger
_CHUNK = 1 << 14  # Gaussians at a time when packing: every bit takes a byte meanwhile
_LEAST_SPREAD = 1e-30
_SAMPLE = 20_000  # values that a line is fitted to
_LINE = struct.Struct("<3f")
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


@dataclass(frozen=True)
class Codec:
    """How the Gaussians of one secret are written: a table of bits, and a line for each kind of number."""

    table: Table
    lines: tuple[Line, ...]  # x, y, z, log scales, opacity logits; two per band, the constant one first

    @staticmethod
    def fit(gaussians: Gaussians, table: Table) -> Codec:
        """The lines that suit `gaussians`, of which the table must have the SH degree."""
        if table.sh_degree != gaussians.sh_degree:
            raise ValueError(f"SH degree {gaussians.sh_degree}, but the table is for {table.sh_degree}")
        means = [_asinh_line(_doubles(gaussians.means[:, axis])) for axis in range(3)]
        flat = [_even_line(_doubles(gaussians.log_scales)), _even_line(_logits(gaussians))]
        colours = [_best_line(*each) for each in _colours(gaussians, table)]
        return Codec(table, (*means, *flat, *colours))

    def encode(self, gaussians: Gaussians) -> Bytes:
        """[N, record_bytes] the records of N Gaussians; the bits left over are zero."""
        records = np.empty((len(gaussians), self.table.record_bytes), np.uint8)
        for start in range(0, len(gaussians), _CHUNK):
            part = slice(start, start + _CHUNK)
            records[part] = _packed(self._codes(gaussians[part]))
        return records

    def decode(self, records: Bytes) -> Gaussians:
        """The Gaussians of records [N, record_bytes]: finite float32, whatever bytes they are."""
        starts = range(0, max(len(records), 1), _CHUNK)
        return Gaussians.cat([self._values(records[start : start + _CHUNK]) for start in starts])

    def pack(self) -> bytes:
        """The codec itself: 92 to 164 bytes."""
        numbers = b"".join(_LINE.pack(line.centre, line.spread, line.reach) for line in self.lines)
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
            lines = tuple(Line(*values) for values in _LINE.iter_unpack(numbers))
        except (ValueError, struct.error) as error:
            raise InputError(f"the hidden parameters are damaged: {error}") from error
        if len(lines) != 7 + 2 * table.sh_degree:
            raise InputError("the hidden parameters are damaged: they are too short")
        return Codec(table, lines)

    def _codes(self, gaussians: Gaussians) -> Iterator[tuple[Codes, int]]:
        """Columns of codes and the bits of each."""
        lines, (means, log_scales, quats, opacity, *_) = iter(self.lines), self.table.bits
        for axis in range(3):
            yield next(lines).encode(_doubles(gaussians.means[:, axis : axis + 1]), means), means
        yield next(lines).encode(_doubles(gaussians.log_scales), log_scales), log_scales
        yield next(lines).encode(_logits(gaussians)[:, None], opacity), opacity
        left_out, three = _three_smallest(_doubles(gaussians.quats))
        yield left_out, 2
        yield _QUAT_LINE.encode(three, quats), quats
        for values, bits, _ in _colours(gaussians, self.table):
            yield next(lines).encode(values.reshape(len(values), -1), bits), bits

    def _values(self, records: Bytes) -> Gaussians:
        lines, (means, log_scales, quats, opacity, *colours) = iter(self.lines), self.table.bits
        unread = np.unpackbits(records, axis=1)

        def codes(columns: int, bits: int) -> Codes:
            """[N, columns] the next codes, in the order in which they were packed."""
            nonlocal unread
            part, unread = np.split(unread, [columns * bits], axis=1)
            powers = np.uint32(1) << np.arange(bits, dtype=np.uint32)[::-1]
            return part.reshape(-1, columns, bits) @ powers

        def values(columns: int, bits: int) -> Floats:
            return next(lines).decode(codes(columns, bits), bits)

        positions = np.concatenate([values(1, means) for _ in range(3)], axis=1)
        sizes, logits = values(3, log_scales), values(1, opacity)[:, 0]
        left_out = codes(1, 2)
        turns = _whole_quats(left_out, _QUAT_LINE.decode(codes(3, quats), quats))
        harmonics = []
        for count, bits in zip(BANDS, colours, strict=False):
            brightness = values(count, bits)[:, :, None]
            differences = values(2 * count, bits - CHROMA_FEWER).reshape(-1, count, 2)
            harmonics.append(np.concatenate([brightness, differences], axis=2) @ OPPONENT)
        sh = np.concatenate(harmonics, axis=1)
        return Gaussians(*(torch.from_numpy(v).float() for v in (positions, turns, sizes, logits, sh)))


def _packed(columns: Iterator[tuple[Codes, int]]) -> Bytes:
    """[N, bytes] the codes one after the other, the highest bit of each first."""
    parts = []
    for codes, bits in columns:
        shifts = np.arange(bits - 1, -1, -1, dtype=np.uint32)
        parts.append((codes[:, :, None] >> shifts & 1).astype(np.uint8).reshape(len(codes), -1))
    return np.packbits(np.concatenate(parts, axis=1), axis=1)


def _three_smallest(quats: Floats) -> tuple[Codes, Floats]:
    """[N, 1] which component is the largest, and [N, 3] the others, of the unit quaternion with it > 0."""
    length = np.linalg.norm(quats, axis=1, keepdims=True)
    unit = np.where(length > 0, quats / np.where(length > 0, length, 1), [1.0, 0, 0, 0])
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


def _even_line(values: Floats) -> Line:
    low, high = float(values.min()), float(values.max())
    return _line((low + high) / 2, 0, (high - low) / 2)


def _asinh_line(values: Floats) -> Line:
    """A line on which all values lie."""
    centre = float(np.median(values))
    spread = float(np.abs(values - centre).mean()) or 1.0
    return _line(centre, spread, float(np.arcsinh(np.abs(values - centre).max() / spread)))


def _best_line(values: Floats, bits: int, centred: bool) -> Line:
    """Of some lines that reach to the furthest value or less far the one with the least error."""
    flat = values.ravel()
    centre = 0.0 if centred else float(np.median(flat))
    spread = float(np.abs(flat - centre).mean()) or 1.0
    furthest = float(np.abs(flat - centre).max()) or 1.0
    sample = flat[:: max(1, len(flat) // _SAMPLE)]
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


def _line(centre: float, spread: float, reach: float) -> Line:
    """A line whose numbers are of single precision, as they are stored, and that is longer than a point."""
    reach = max(reach * (1 + 1e-6), 1e-6)
    spread = max(spread, _LEAST_SPREAD) if spread > 0 else 0.0
    return Line(*_LINE.unpack(_LINE.pack(centre, spread, reach)))


def _colours(gaussians: Gaussians, table: Table) -> Iterator[tuple[Floats, int, bool]]:
    """Each band's brightness [N, count] and differences [N, count, 2]; bits; whether zero is the centre."""
    for band, bits in enumerate(table.bits[4:]):
        rotated = _doubles(gaussians.sh[:, band**2 : (band + 1) ** 2]) @ OPPONENT.T
        yield rotated[:, :, 0], bits, band > 0
        yield rotated[:, :, 1:], bits - CHROMA_FEWER, band > 0


def _doubles(values: torch.Tensor) -> Floats:
    return values.detach().cpu().numpy().astype(np.float64)


def _logits(gaussians: Gaussians) -> Floats:
    return _doubles(gaussians.opacity_logits.clamp(-MAX_LOGIT, MAX_LOGIT))
