"""Quantise Gaussians to records of a fixed number of bits.

A record holds position, log scales, opacity logit, unit quaternion, colour and spherical harmonics. A `Line`
maps numbers to codes:

- log scales and opacity logits: evenly spaced between their extremes;
- positions, colours and harmonics: spaced by asinh((value - centre) / spread), which is linear near the
  centre and logarithmic further out. Lines of positions reach all of them; other lines may clip a few numbers
  if that reduces the mean square error;
- three colours: brightness and two small differences, each on a line of its own;
- quaternions: the three smallest components, none above sqrt(1/2), and the index of the largest.

Lines are fitted to the bulk. A Gaussian with a number far outside of it is an *outlier*: one bit of its
record is set, and its numbers use the same lines with a longer reach. Outliers thus cost the bulk one bit,
whatever their numbers. Extreme numbers, which occlude everything or are invisible, are clamped.
"""

from __future__ import annotations

import math
import struct
from dataclasses import astuple, dataclass, replace
from typing import Any

import numpy as np
import torch

from keyss.core.arrays import Bytes, Doubles, Flags, Integers, doubles
from keyss.core.errors import InputError
from keyss.core.gaussians import MAX_COORDINATE, MAX_LOG_SCALE, OPPONENT, Gaussians, magnitude
from keyss.files.formats.common import smallest_three, unit
from keyss.kernels.jit import kernel
from keyss.kernels.parallel import in_blocks
from keyss.methods.records.lines import (
    BANDS,
    COLOUR,
    EVEN,
    HARMONIC,
    LINE,
    POSITION,
    Kind,
    Line,
    Table,
    fit_line,
    inlier_range,
)

MAX_LOGIT = 16.0  # beyond it the float32 sigmoid is exactly 0 or 1
_MAX_HARMONIC = 1e6  # beyond it every rendered colour is black or white
_MIN_LENGTH = 1e-12  # shorter quaternions define no rotation
_SAMPLE = 20_000  # Gaussians for finding the range of inliers, and for fitting lines
_TABLE_BITS = 14  # codes of at most this size use a lookup table, which is faster than `sinh`
_BLOCK = 1 << 12  # Gaussians per block, which fits into the cache
_TABLE_BYTES = 8  # one per attribute or band; 0 for missing bands of harmonics
_QUAT_LINE = Line(0, 0, 0.5**0.5, 0.5**0.5)  # three smallest components of quaternions


@dataclass(frozen=True)
class Codec:
    """The encoding of one secret's Gaussians: a table of bits, and lines for their numbers."""

    table: Table
    lines: tuple[Line, ...]  # x, y, z, log scales, opacity logits; two per band, the constant one first

    @staticmethod
    def fit(gaussians: Gaussians, table: Table) -> tuple[Codec, Flags]:
        """Fit lines to `gaussians`, and find the outliers [N] among them; none if that were all."""
        found, parts = _bulk(gaussians)
        every = zip(_kinds(table.sh_degree), table.layout[3:], parts, strict=True)
        return Codec(table, tuple(fit_line(kind, bits, *line) for kind, (_, bits), line in every)), found

    def encode(self, gaussians: Gaussians, outlier: Flags) -> Bytes:
        """[N, record_bytes] records: concatenated codes, most significant bit first, padded with zeros.

        `outlier` [N]: see `fit`.
        """
        bits, records = self._code_bits(), np.zeros((len(gaussians), self.table.record_bytes), np.uint8)

        def encode(start: int, stop: int) -> None:
            part, far = gaussians[start:stop], outlier[start:stop]
            quats = doubles(part.quats)
            quats[np.linalg.norm(quats, axis=1) <= _MIN_LENGTH] = 0
            left_out, three = smallest_three(unit(quats))
            columns = [each[:, None].astype(np.uint32) for each in (far, left_out)]
            columns.append(_QUAT_LINE.encode(three, self.table.bits[2]))
            every = zip(self.lines, self.table.layout[3:], numbers_of(part), strict=True)
            columns += [line.encode(values, own, far) for line, (_, own), values in every]
            _pack(np.concatenate(columns, axis=1), bits, records[start:stop])

        in_blocks(encode, len(gaussians), _BLOCK)
        return records

    def _code_bits(self) -> Integers:
        """[C] bits of each code of a record."""
        return np.array([bits for columns, bits in self.table.layout for _ in range(columns)])

    def decode(self, records: Bytes) -> Gaussians:
        """Decode records [N, record_bytes]. Any bytes give finite float32 Gaussians."""
        k = (self.table.sh_degree + 1) ** 2
        fields = [np.empty((len(records), *shape), np.float32) for shape in ((3,), (4,), (3,), (), (k, 3))]
        bits, tables = self._code_bits(), self._tables()

        def decode(start: int, stop: int) -> None:
            _decode(records[start:stop], bits, *tables, OPPONENT, *(each[start:stop] for each in fields))

        in_blocks(decode, len(records), _BLOCK)
        return Gaussians(*map(torch.from_numpy, fields))

    def _tables(self) -> tuple[Doubles, Integers, Doubles]:
        """Tables for `_decode`.

        Numbers of all codes of few bits, bulk then outliers; start [C] of each code's numbers, -1 for codes
        of more bits; lines [C, 4].
        """
        numbers, starts, lines, size = [np.zeros(0)], [-1, -1], [_QUAT_LINE] * 2, 0
        for line, (columns, bits) in zip((_QUAT_LINE, *self.lines), self.table.layout[2:], strict=True):
            few = bits <= _TABLE_BITS
            starts += [size if few else -1] * columns
            lines += [line] * columns
            if few:
                every_code = np.arange(1 << bits, dtype=np.uint32)[:, None]
                for each in (line, replace(line, reach=line.far_reach)):
                    numbers.append(each.decode(every_code, bits)[:, 0])
                size += 2 << bits
        return np.concatenate(numbers), np.array(starts), np.array([astuple(each) for each in lines])

    def pack(self) -> bytes:
        """The codec as 92 to 164 bytes."""
        lines = (LINE.pack(*astuple(line)) for line in self.lines)
        return bytes(self.table.bits).ljust(_TABLE_BYTES, b"\0") + b"".join(lines)

    @staticmethod
    def packed_size(sh_degree: int) -> int:
        """Bytes of a packed codec for secrets of this SH degree."""
        return _TABLE_BYTES + LINE.size * (7 + 2 * sh_degree)

    @staticmethod
    def unpack(data: bytes) -> Codec:
        """Invert `pack`; ignores further bytes. Raises InputError for damage."""
        try:
            table = Table(tuple(data[:_TABLE_BYTES].rstrip(b"\0")))
            numbers = data[_TABLE_BYTES : Codec.packed_size(table.sh_degree)]
            lines = tuple(Line(*each) for each in LINE.iter_unpack(numbers))
        except (ValueError, struct.error) as error:
            raise InputError(f"the hidden parameters are damaged: {error}") from error
        if len(lines) != 7 + 2 * table.sh_degree:
            raise InputError("the hidden parameters are damaged: they are too short")
        return Codec(table, lines)


@kernel
def _pack(codes: Any, bits: Any, records: Any) -> None:
    """Pack codes [N, C] of `bits` [C] into zero-initialised `records` [N, bytes]."""
    for i in range(len(codes)):
        held, count, at = np.uint64(0), 0, 0  # the lowest `count` bits of `held` are pending
        for j in range(len(bits)):
            held = held << np.uint64(bits[j]) | np.uint64(codes[i, j])
            count += bits[j]
            while count >= 8:
                count -= 8
                records[i, at] = held >> np.uint64(count) & np.uint64(255)
                at += 1
        if count:
            records[i, at] = held << np.uint64(8 - count) & np.uint64(255)


@kernel
def _decode(
    records: Any,
    bits: Any,
    numbers: Any,
    starts: Any,
    lines: Any,
    opponent: Any,
    means: Any,
    quats: Any,
    log_scales: Any,
    opacity_logits: Any,
    sh: Any,
) -> None:
    """Decode records into the fields of Gaussians; `numbers`, `starts`, `lines`: see `_tables`.

    Codes of a record, as from `Codec.encode`: outlier, left out, 3 of the quaternion, 3 of the position, 3
    scales, opacity; then, for each band, brightness and two differences of each harmonic.
    """
    values = np.empty(len(bits))
    for i in range(len(records)):
        held, count, at = np.uint64(0), 0, 0
        outlier, left_out = np.int64(0), np.int64(0)
        for j in range(len(bits)):
            while count < bits[j]:
                held = held << np.uint64(8) | np.uint64(records[i, at])
                count += 8
                at += 1
            count -= bits[j]
            code = np.int64(held >> np.uint64(count) & (np.uint64(1) << np.uint64(bits[j])) - np.uint64(1))
            if j == 0:
                outlier = code
            elif j == 1:
                left_out = code
            elif starts[j] >= 0:
                values[j] = numbers[starts[j] + (outlier << bits[j]) + code]
            else:
                centre, spread, reach, far_reach = lines[j]
                step = 2 / ((1 << bits[j]) - 1)
                position = (code * step - 1) * (far_reach if outlier else reach)
                values[j] = (math.sinh(position) * spread if spread > 0 else position) + centre
        squares = 0.0
        for j in range(3):
            squares += values[2 + j] ** 2
            means[i, j], log_scales[i, j] = values[5 + j], values[8 + j]
        opacity_logits[i] = values[11]
        length = max(1.0, math.sqrt(squares))  # invalid codes may be longer
        for j in range(3):
            quats[i, j + (j >= left_out)] = values[2 + j] / length
        quats[i, left_out] = math.sqrt(max(0.0, 1 - squares))
        j, first, band = 12, 0, 1
        while first < sh.shape[1]:
            for k in range(band):
                bright, a, b = values[j + k], values[j + band + 2 * k], values[j + band + 2 * k + 1]
                for c in range(3):
                    sh[i, first + k, c] = bright * opponent[0, c] + a * opponent[1, c] + b * opponent[2, c]
            j, first, band = j + 3 * band, first + band, band + 2


def _bulk(gaussians: Gaussians) -> tuple[Flags, list[tuple[Doubles, Doubles, Doubles]]]:
    """The outliers [N], with a number far outside of the bulk.

    Per line, a sample of the bulk's numbers, the bulk's extent and the outliers'.
    """
    found, every = np.zeros(len(gaussians), bool), max(1, len(gaussians) // _SAMPLE)
    sample = numbers_of(gaussians[::every])
    ends = list(map(inlier_range, sample, _kinds(gaussians.sh_degree)))

    def scan(start: int, stop: int) -> list[list[tuple[float, float]]]:
        numbers, own = numbers_of(gaussians[start:stop]), found[start:stop]
        for values, (least, largest) in zip(numbers, ends, strict=True):
            own |= ((values < least) | (values > largest)).any(axis=1)
        parts = ((values[~own], values[own]) for values in numbers)
        return [[(x.min(initial=np.inf), -x.max(initial=-np.inf)) for x in each] for each in parts]

    extents = np.min(in_blocks(scan, len(gaussians), _BLOCK), axis=0) * (1, -1)  # [lines, 2, 2]
    if found.all():
        found, extents = ~found, extents[:, ::-1]
    return found, [(x[~found[::every]], *each) for x, each in zip(sample, extents, strict=True)]


def out_of_range(gaussians: Gaussians) -> int:
    """The number of Gaussians with extreme numbers, which records clamp."""
    beyond = gaussians.overflow | (gaussians.log_scales < -MAX_LOG_SCALE).any(1)
    if magnitude(gaussians.sh) > _MAX_HARMONIC:
        beyond |= (gaussians.sh.abs() > _MAX_HARMONIC).flatten(1).any(1)
    return int(beyond.sum())


def _kinds(sh_degree: int) -> list[Kind]:
    """The kind of each line: x, y, z, log scales, opacity logits; two per band, the constant one first."""
    return [POSITION] * 3 + [EVEN] * 2 + [COLOUR] * 2 + [HARMONIC] * 2 * sh_degree


def numbers_of(gaussians: Gaussians) -> list[Doubles]:
    """The numbers [N, count] of each line.

    Rasterizers skip Gaussians whose numbers overflow. Clamped numbers would make these visible, so they
    become transparent.
    """
    own = gaussians.detach().to("cpu")
    fields = (own.means, own.log_scales, own.opacity_logits, own.sh, own.overflow)
    found = np.empty((len(own), 7 + 3 * own.sh.shape[1]))
    _find_numbers(*(np.ascontiguousarray(each.numpy()) for each in fields), OPPONENT, found)
    counts = [1, 1, 1, 3, 1, *(each * count for count in BANDS[: own.sh_degree + 1] for each in (1, 2))]
    return np.split(found, np.cumsum(counts)[:-1], axis=1)


@kernel
def _find_numbers(
    means: Any, log_scales: Any, opacity_logits: Any, sh: Any, overflow: Any, opponent: Any, found: Any
) -> None:
    """Write the clamped numbers of all lines into `found` [N, 7 + 3 K]."""
    for i in range(len(found)):
        for j in range(3):
            found[i, j] = min(max(means[i, j], -MAX_COORDINATE), MAX_COORDINATE)
            found[i, 3 + j] = min(max(log_scales[i, j], -MAX_LOG_SCALE), MAX_LOG_SCALE)
        found[i, 6] = -MAX_LOGIT if overflow[i] else min(max(opacity_logits[i], -MAX_LOGIT), MAX_LOGIT)
        j, first, band = 7, 0, 1
        while first < sh.shape[1]:
            for k in range(band):
                bright, a, b = 0.0, 0.0, 0.0
                for c in range(3):
                    value = min(max(sh[i, first + k, c], -_MAX_HARMONIC), _MAX_HARMONIC)
                    bright += value * opponent[0, c]
                    a += value * opponent[1, c]
                    b += value * opponent[2, c]
                found[i, j + k] = bright
                found[i, j + band + 2 * k], found[i, j + band + 2 * k + 1] = a, b
            j, first, band = j + 3 * band, first + band, band + 2
