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
from dataclasses import astuple, dataclass

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
_LARGEST_QUAT = 0.5**0.5
_FURTHEST = 1e30  # no value that a line may give is larger
_CHUNK = 1 << 14  # Gaussians at a time when packing: every bit takes a byte meanwhile
_LEAST_SPREAD = 1e-30
_SAMPLE = 20_000  # values that a line is fitted to
_LINE = struct.Struct("<3f")
_TABLE_BYTES = len(astuple(Table.floor(0)))
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
        colours = [
            _best_line(values, bits, centred=band > 0)
            for band in range(table.sh_degree + 1)
            for values, bits in _colours(gaussians, table, band)
        ]
        return Codec(table, (*means, *flat, *colours))

    @property
    def record_bytes(self) -> int:
        """Whole bytes of a record."""
        return -(-self.table.total // 8)

    def encode(self, gaussians: Gaussians) -> Bytes:
        """[N, record_bytes] the records of N Gaussians; the bits left over are zero."""
        records = np.empty((len(gaussians), self.record_bytes), np.uint8)
        for start in range(0, len(gaussians), _CHUNK):
            part = self._codes(gaussians[start : start + _CHUNK])
            records[start : start + _CHUNK] = _packed(part)
        return records

    def decode(self, records: Bytes) -> Gaussians:
        """The Gaussians of records [N, record_bytes]: finite float32, whatever bytes they are."""
        parts = [
            self._values(records[start : start + _CHUNK]) for start in range(0, max(len(records), 1), _CHUNK)
        ]
        return Gaussians.cat(parts)

    def pack(self) -> bytes:
        """The codec itself: 92 to 164 bytes."""
        numbers = b"".join(_LINE.pack(line.centre, line.spread, line.reach) for line in self.lines)
        return bytes(astuple(self.table)) + numbers

    @staticmethod
    def packed_size(sh_degree: int) -> int:
        """Bytes of a packed codec for secrets of this SH degree."""
        return _TABLE_BYTES + _LINE.size * (7 + 2 * sh_degree)

    @staticmethod
    def size_from(data: bytes) -> int:
        """Bytes of the packed codec that `data` begins with. Raises InputError if it is none."""
        return Codec.packed_size(_unpack_table(data).sh_degree)

    @staticmethod
    def unpack(data: bytes) -> Codec:
        """The codec of `pack`; what follows it is ignored. Raises InputError for anything else."""
        table = _unpack_table(data)
        try:
            numbers = data[_TABLE_BYTES : Codec.packed_size(table.sh_degree)]
            lines = tuple(Line(*values) for values in _LINE.iter_unpack(numbers))
        except (ValueError, struct.error) as error:
            raise InputError(f"the hidden parameters are damaged: {error}") from error
        if len(lines) != 7 + 2 * table.sh_degree:
            raise InputError("the hidden parameters are damaged: they are too short")
        return Codec(table, lines)

    def _codes(self, gaussians: Gaussians) -> Iterator[tuple[Codes, int]]:
        """Columns of codes and the bits of each."""
        table, lines = self.table, iter(self.lines)
        for axis in range(3):
            yield next(lines).encode(_doubles(gaussians.means[:, axis : axis + 1]), table.means), table.means
        yield next(lines).encode(_doubles(gaussians.log_scales), table.log_scales), table.log_scales
        yield next(lines).encode(_logits(gaussians)[:, None], table.opacity), table.opacity
        left_out, three = _three_smallest(_doubles(gaussians.quats))
        yield left_out, 2
        yield Line(0, 0, _LARGEST_QUAT).encode(three, table.quats), table.quats
        for band in range(table.sh_degree + 1):
            for values, bits in _colours(gaussians, table, band):
                yield next(lines).encode(values.reshape(len(values), -1), bits), bits

    def _values(self, records: Bytes) -> Gaussians:
        table, lines, read = self.table, iter(self.lines), _Unpacker(records)
        means = np.concatenate([next(lines).decode(read(1, table.means), table.means) for _ in range(3)], 1)
        log_scales = next(lines).decode(read(3, table.log_scales), table.log_scales)
        logits = next(lines).decode(read(1, table.opacity), table.opacity)[:, 0]
        left_out = read(1, 2)
        quats = _whole_quats(left_out, Line(0, 0, _LARGEST_QUAT).decode(read(3, table.quats), table.quats))
        harmonics = []
        for count, bits in zip((1, *BANDS), (table.dc, *table.bands), strict=False):
            brightness = next(lines).decode(read(count, bits), bits)[:, :, None]
            bits -= CHROMA_FEWER
            differences = next(lines).decode(read(2 * count, bits), bits).reshape(-1, count, 2)
            harmonics.append(np.concatenate([brightness, differences], axis=2) @ OPPONENT)
        sh = np.concatenate(harmonics, axis=1)
        return Gaussians(*(torch.from_numpy(v).float() for v in (means, quats, log_scales, logits, sh)))


class _Unpacker:
    """Reads columns of codes from records, in the order in which they were packed."""

    def __init__(self, records: Bytes) -> None:
        self._bits = np.unpackbits(records, axis=1)
        self._next = 0

    def __call__(self, columns: int, bits: int) -> Codes:
        part = self._bits[:, self._next : self._next + columns * bits].reshape(-1, columns, bits)
        self._next += columns * bits
        codes = np.zeros(part.shape[:2], np.uint32)
        for bit in range(bits):
            codes = codes << np.uint32(1) | part[:, :, bit]
        return codes


def _unpack_table(data: bytes) -> Table:
    try:
        return Table(*data[:_TABLE_BYTES])
    except (ValueError, TypeError) as error:
        raise InputError(f"the hidden parameters are damaged: {error}") from error


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


def _best_line(values: Floats, bits: int, *, centred: bool = False) -> Line:
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


def _colours(gaussians: Gaussians, table: Table, band: int) -> Iterator[tuple[Floats, int]]:
    """A band's brightness [N, count] and differences [N, count, 2], with the bits of each."""
    bits = (table.dc, *table.bands)[band]
    rotated = _doubles(gaussians.sh[:, band**2 : (band + 1) ** 2]) @ OPPONENT.T
    yield rotated[:, :, 0], bits
    yield rotated[:, :, 1:], bits - CHROMA_FEWER


def _doubles(values: torch.Tensor) -> Floats:
    return values.detach().cpu().numpy().astype(np.float64)


def _logits(gaussians: Gaussians) -> Floats:
    return _doubles(gaussians.opacity_logits.clamp(-MAX_LOGIT, MAX_LOGIT))
