"""Lines that map numbers to codes, and tables of the bits of each attribute; see `quantise`."""

from __future__ import annotations

import struct
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from keyss.core.arrays import Doubles, Flags, Words32

_TAIL = 0.05  # share of the numbers on each side that the quantiles of the bulk leave out
_EVEN_MARGIN = 0.75  # evenly spaced lines: distance to the first outlier / width of the bulk
_FAR = 8.0  # asinh lines: distance from the median to the first outlier / that to the end of the bulk
_FURTHEST = 1e30  # lines give no larger numbers
_MIN_SPREAD = 1e-9
_HALF = 1e-3  # maximum relative rounding error of half precision, which stores reaches
_SAMPLE = 20_000  # numbers for comparing candidate lines
LINE = struct.Struct("<2f2e")  # centre, spread, reach, far reach
# Weight of the part of the error that shrinks numbers on average. Lines of minimum square error shrink them,
# which lowers quality against photos more than errors independent of the numbers.
_SHRINKING_WEIGHT = 20.0
MAX_BITS = 24  # bits per number: float32 has no more
CHROMA_FEWER = 2  # bits
BANDS = (1, 3, 5, 7)  # spherical harmonics of degrees 0 to 3; each of three colours

# Bits at which quantising one attribute gives 60 dB against the unquantised model, measured on models of
# bonsai and fox (200 px, 20,000 Gaussians). A bit is 6 dB. Spherical harmonics get 0.8 bits more, and at
# least as many as highlights need, by PSNR against photos.
_BITS_FOR_60_DB = (15.5, 8.8, 8.2, 7.2, 8.2, 5.2, 5.4, 5.4)
_NUMBERS = (3, 3, 3, 1, *(3 * count for count in BANDS))
_FLOOR = (15, 8, 8, 7, 8, 4, 4, 4)


@dataclass(frozen=True)
class Line:
    """Codes 0 to 2^bits - 1 for evenly spaced positions from -reach to reach.

    The position of a number is its distance from the centre, or asinh(distance / spread).
    """

    centre: float
    spread: float  # 0: positions are distances
    reach: float  # the largest position
    far_reach: float  # the largest position of outliers

    def __post_init__(self) -> None:
        """Raise ValueError unless all codes decode to bounded numbers."""
        reach, least = max(self.reach, self.far_reach), min(self.reach, self.far_reach)
        bounded = abs(self.centre) < _FURTHEST and 0 <= self.spread < _FURTHEST
        if not (bounded and 0 < least <= reach < _FURTHEST):
            raise ValueError(f"no such line: {self}")
        if self.spread > 0 and (reach > 60 or self.spread * np.sinh(reach) > _FURTHEST):
            raise ValueError(f"no such line: {self}")

    def encode(self, values: Doubles, bits: int, outlier: Flags | None = None) -> Words32:
        """The nearest codes of `values` [N, C], clipped; `outlier` [N]: use the far reach."""
        return self.codes(self.positions(values), bits, outlier)

    def positions(self, values: Doubles) -> Doubles:
        """The positions of `values`, independent of the reach."""
        offset: Doubles = values - self.centre
        return np.arcsinh(offset / self.spread) if self.spread > 0 else offset

    def codes(self, positions: Doubles, bits: int, outlier: Flags | None = None) -> Words32:
        """`encode`, for values at `positions`."""
        reach = self.reach if outlier is None else np.where(outlier, self.far_reach, self.reach)[:, None]
        last = (1 << bits) - 1
        return np.rint((positions / reach + 1) * (last / 2)).clip(0, last).astype(np.uint32)

    def decode(self, codes: Words32, bits: int) -> Doubles:
        """The values of `codes` [N, C]; see `encode`."""
        positions = (codes.astype(np.float64) * (2 / ((1 << bits) - 1)) - 1) * self.reach
        offset: Doubles = np.sinh(positions) * self.spread if self.spread > 0 else positions
        return offset + self.centre


class Kind(NamedTuple):
    """The type of line for one kind of number."""

    even: bool = False  # evenly spaced, else by asinh
    clips: bool = False  # the furthest numbers of the bulk may be clipped
    centred: bool = False  # the centre is zero, else the median


EVEN, POSITION = Kind(even=True), Kind()
COLOUR, HARMONIC = Kind(clips=True), Kind(clips=True, centred=True)


def inlier_range(values: Doubles, kind: Kind) -> tuple[float, float]:
    """Minimum and maximum of the inliers of `values`.

    The range follows from quantiles, which a share of values below `_TAIL` cannot move beyond the others.
    Outliers therefore lengthen an evenly spaced line at most 2.5 times (the bulk and two margins), and cost
    at most that factor in precision.
    """
    if kind.even:
        low = float(np.quantile(values, _TAIL, method="higher"))
        high = float(np.quantile(values, 1 - _TAIL, method="lower"))
        margin = _EVEN_MARGIN * (high - low)
        return low - margin, high + margin
    centre = float(np.median(values))
    reach = _FAR * float(np.quantile(np.abs(values - centre), 1 - _TAIL, method="lower"))
    return centre - reach, centre + reach


def fit_line(kind: Kind, bits: int, sample: Doubles, bulk: Doubles, outliers: Doubles) -> Line:
    """Fit a line to a `sample` [N, C] of the bulk, with a far reach for the outliers.

    `bulk` and `outliers` [2]: minimum and maximum of each, infinities if empty.
    """
    if kind.even:
        centre, spread = float(bulk.sum()) / 2, 0.0
    else:
        centre = 0.0 if kind.centred else float(np.median(sample))
        spread = max(float(np.abs(sample - centre).mean()), _MIN_SPREAD)
    line = Line(float(np.float32(centre)), float(np.float32(spread)), 1, 1)
    line = replace(line, reach=_reach_of(line, _furthest(line, bulk)))
    if kind.clips:
        line = _best_line(line, bits, sample, bulk)
    return replace(line, far_reach=_reach_of(line, _furthest(line, outliers)))


def _best_line(whole: Line, bits: int, values: Doubles, bulk: Doubles) -> Line:
    """The line of minimum error among other spreads, and reaches up to that of `whole`."""
    sample = values[:: max(1, values.size // _SAMPLE)].ravel()
    furthest = _furthest(whole, bulk) or 1.0
    best, least = whole, np.inf
    for scale in (0.5, 1.0, 2.0, 4.0):
        line = replace(whole, spread=float(np.float32(scale * whole.spread)))
        positions = line.positions(sample)
        for distance in np.geomspace(min(0.5 * whole.spread, furthest), furthest, 12):
            line = replace(line, reach=_reach_of(line, float(distance)))
            error = line.decode(line.codes(positions, bits), bits) - sample
            shrinking = float((error * (sample - line.centre)).mean()) ** 2 / whole.spread**2
            cost = float(np.square(error).mean()) + _SHRINKING_WEIGHT * shrinking
            if cost < least:
                best, least = line, cost
    return best


def _furthest(line: Line, extent: Doubles) -> float:
    """The largest distance from the centre; 0 if there are no values."""
    return max(0.0, line.centre - float(extent[0]), float(extent[1]) - line.centre)


def _reach_of(line: Line, distance: float) -> float:
    """The reach that covers numbers up to `distance` from the centre, as `LINE` stores it."""
    position = line.positions(np.array([line.centre + distance]))[0]
    return float(np.float16(max((1 + _HALF) * position, _HALF)))


@dataclass(frozen=True)
class Table:
    """Bits per number of positions, log scales, quaternions, opacity and each band of harmonics.

    For harmonics, including the constant ones, these are the bits of the brightness. The two colour
    differences, which have a tenth of the energy, get two fewer. Raises ValueError for bits out of range.
    """

    bits: tuple[int, ...]

    def __post_init__(self) -> None:
        if not 5 <= len(self.bits) <= 8 or not all(1 <= each <= MAX_BITS for each in self.bits):
            raise ValueError(f"bits out of range: {self}")
        if min(self.bits[4:]) <= CHROMA_FEWER:
            raise ValueError(f"no bits are left for differences of colours: {self}")

    @staticmethod
    def floor(sh_degree: int) -> Table:
        """The smallest table for records: about 50 dB against the unquantised model."""
        return Table(_FLOOR[: 5 + sh_degree])

    @staticmethod
    def of_size(bits: int, sh_degree: int) -> Table | None:
        """The table of minimum error with at most `bits`; None if the floor does not fit.

        Each further bit goes to the attribute whose error it reduces most.
        """
        table = Table.floor(sh_degree)
        while (left := bits - table.total) >= 0:
            given = table.bits
            grow = [i for i, each in enumerate(given) if _NUMBERS[i] <= left and each < MAX_BITS]
            if not grow:
                return table
            best = max(grow, key=lambda i: 4 ** (_BITS_FOR_60_DB[i] - given[i]) / _NUMBERS[i])
            table = Table((*given[:best], given[best] + 1, *given[best + 1 :]))
        return None

    @property
    def sh_degree(self) -> int:
        return len(self.bits) - 5

    @property
    def total(self) -> int:
        """Bits per record: its numbers, 1 for outliers, 2 for the largest component of the quaternion."""
        numbers = sum(each * count for each, count in zip(self.bits, _NUMBERS, strict=False))
        return 3 + numbers - 2 * CHROMA_FEWER * sum(BANDS[: self.sh_degree + 1])

    @property
    def record_bytes(self) -> int:
        """Bytes per record."""
        return -(-self.total // 8)

    @property
    def layout(self) -> list[tuple[int, int]]:
        """(columns, bits) of a record's codes: outlier, largest component of the quaternion, ..."""
        means, log_scales, quats, opacity, *colours = self.bits
        positions = [(1, means)] * 3
        layout = [(1, 1), (1, 2), (3, quats), *positions, (3, log_scales), (1, opacity)]
        for count, bits in zip(BANDS, colours, strict=False):
            layout += [(count, bits), (2 * count, bits - CHROMA_FEWER)]
        return layout
