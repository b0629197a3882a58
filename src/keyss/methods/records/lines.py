"""Lines that map numbers to codes, and tables of the bits of each attribute; see `quantise`."""

from __future__ import annotations

import struct
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from keyss.core.arrays import Doubles, Flags, Words32

_TAIL = 0.05  # share of the numbers that is ignored on each side when the extent of the bulk is measured
_EVEN_MARGIN = 0.75  # on an evenly spaced line, widths of the bulk between it and the first outlier
_FAR = 8.0  # on an asinh line, distances of the bulk from the median up to the first outlier
_FURTHEST = 1e30  # no line gives a larger number
_MIN_SPREAD = 1e-9
_HALF = 1e-3  # half precision, in which reaches are stored, rounds by less than this share
_SAMPLE = 20_000  # numbers that the candidates for a line are compared on
LINE = struct.Struct("<2f2e")  # centre, spread, reach, far reach
# The line with the least square error makes numbers smaller on average, which costs more against photos than
# errors that are independent of the numbers: this part of the error gets this weight.
_SHRINKING_WEIGHT = 20.0
MAX_BITS = 24  # bits per number: float32 has no more
CHROMA_FEWER = 2  # bits
BANDS = (1, 3, 5, 7)  # spherical harmonics of degrees 0 to 3; each of three colours

# Bits with which quantising an attribute alone leaves 60 dB to the unquantised model, measured on models of
# bonsai and fox (200 px, 20,000 Gaussians). One bit more or less is 6 dB. Spherical harmonics get 0.8 more,
# and at least as many as highlights need, which PSNR against photos shows.
_BITS_FOR_60_DB = (15.5, 8.8, 8.2, 7.2, 8.2, 5.2, 5.4, 5.4)
_NUMBERS = (3, 3, 3, 1, *(3 * count for count in BANDS))
_FLOOR = (15, 8, 8, 7, 8, 4, 4, 4)


@dataclass(frozen=True)
class Line:
    """Codes 0 .. 2^bits - 1 for evenly spaced positions from -reach to reach.

    The position of a number is its distance from the centre, or the asinh of that distance in spreads.
    """

    centre: float
    spread: float  # 0: positions are distances
    reach: float  # the largest position
    far_reach: float  # the largest position of outliers

    def __post_init__(self) -> None:
        """Raise ValueError unless every code stands for a number of bounded size."""
        reach, least = max(self.reach, self.far_reach), min(self.reach, self.far_reach)
        bounded = abs(self.centre) < _FURTHEST and 0 <= self.spread < _FURTHEST
        if not (bounded and 0 < least <= reach < _FURTHEST):
            raise ValueError(f"no such line: {self}")
        if self.spread > 0 and (reach > 60 or self.spread * np.sinh(reach) > _FURTHEST):
            raise ValueError(f"no such line: {self}")

    def encode(self, values: Doubles, bits: int, outlier: Flags | None = None) -> Words32:
        """The nearest codes of `values` [N, C], clipped at the ends; `outlier` [N]: use the far reach."""
        return self.codes(self.positions(values), bits, outlier)

    def positions(self, values: Doubles) -> Doubles:
        """The positions of `values`, whatever the reach."""
        offset: Doubles = values - self.centre
        return np.arcsinh(offset / self.spread) if self.spread > 0 else offset

    def codes(self, positions: Doubles, bits: int, outlier: Flags | None = None) -> Words32:
        """`encode` of values at these positions."""
        last = (1 << bits) - 1
        codes = np.rint((positions / self._reaches(outlier) + 1) * (last / 2)).clip(0, last)
        return codes.astype(np.uint32)

    def decode(self, codes: Words32, bits: int, outlier: Flags | None = None) -> Doubles:
        """The values that `codes` [N, C] stand for; see `encode`."""
        positions = (codes.astype(np.float64) * (2 / ((1 << bits) - 1)) - 1) * self._reaches(outlier)
        offset: Doubles = np.sinh(positions) * self.spread if self.spread > 0 else positions
        return offset + self.centre

    def _reaches(self, outlier: Flags | None) -> Doubles | float:
        return self.reach if outlier is None else np.where(outlier, self.far_reach, self.reach)[:, None]


class Kind(NamedTuple):
    """Which lines suit the numbers of one kind."""

    even: bool = False  # evenly spaced, else by asinh
    clips: bool = False  # the furthest numbers of the bulk may be clipped
    centred: bool = False  # the centre is zero, else the median


EVEN, POSITION = Kind(even=True), Kind()
COLOUR, HARMONIC = Kind(clips=True), Kind(clips=True, centred=True)


def neighbourhood(values: Doubles, kind: Kind) -> tuple[float, float]:
    """The least and the largest number that is no outlier of `values`.

    Quantiles measure the bulk, and fewer than `_TAIL` of the values, whatever they are, cannot move these
    beyond the others. Such values therefore lengthen an evenly spaced line at most 2.5 times (the bulk and
    two margins), and make each number less precise by the same factor.
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
    """The line for the bulk, of which `sample` [N, C] is a part, with a far reach for the outliers.

    `bulk` and `outliers` [2]: their least and their largest number, infinities where there are none.
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
    """The line with the least error among some with other spreads that reach as far as `whole` or less."""
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
    """The largest distance from the centre; 0 where there are no values."""
    return max(0.0, line.centre - float(extent[0]), float(extent[1]) - line.centre)


def _reach_of(line: Line, distance: float) -> float:
    """The reach that covers numbers at this distance from the centre, as `LINE` stores it."""
    position = line.positions(np.array([line.centre + distance]))[0]
    return float(np.float16(max((1 + _HALF) * position, _HALF)))


@dataclass(frozen=True)
class Table:
    """Bits of one number of positions, log scales, quaternions and opacity, then of each band of harmonics.

    For harmonics, the constant ones included, these are the bits of the brightness; the two differences of
    colours, which have a tenth of the energy, get two fewer. Raises ValueError for bits out of range.
    """

    bits: tuple[int, ...]

    def __post_init__(self) -> None:
        if not 5 <= len(self.bits) <= 8 or not all(1 <= each <= MAX_BITS for each in self.bits):
            raise ValueError(f"bits out of range: {self}")
        if min(self.bits[4:]) <= CHROMA_FEWER:
            raise ValueError(f"no bits are left for differences of colours: {self}")

    @staticmethod
    def floor(sh_degree: int) -> Table:
        """The smallest table in use: about 50 dB against the unquantised model."""
        return Table(_FLOOR[: 5 + sh_degree])

    @staticmethod
    def short() -> Table:
        """A still smaller table of SH degree 0, for payloads: about 40 dB."""
        return Table(tuple(each - 2 for each in _FLOOR[:5]))

    @staticmethod
    def of_size(bits: int, sh_degree: int, start: Table | None = None) -> Table | None:
        """The table for records of at most `bits` with the least error; None if `start` does not fit.

        `start`: by default the floor. Each further bit goes to the attribute that it takes the most error
        from.
        """
        table = start or Table.floor(sh_degree)
        while (room := bits - table.total) >= 0:
            given = table.bits
            grow = [i for i, each in enumerate(given) if _NUMBERS[i] <= room and each < MAX_BITS]
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
        """Bits of a record: its numbers, one for outliers, and two for the largest part of the quaternion."""
        numbers = sum(each * count for each, count in zip(self.bits, _NUMBERS, strict=False))
        return 3 + numbers - 2 * CHROMA_FEWER * sum(BANDS[: self.sh_degree + 1])

    @property
    def record_bytes(self) -> int:
        """Whole bytes of a record."""
        return -(-self.total // 8)

    @property
    def layout(self) -> list[tuple[int, int]]:
        """(columns, bits) of codes in the order of records: outlier, largest part of the quaternion, ..."""
        means, log_scales, quats, opacity, *colours = self.bits
        positions = [(1, means)] * 3
        layout = [(1, 1), (1, 2), (3, quats), *positions, (3, log_scales), (1, opacity)]
        for count, bits in zip(BANDS, colours, strict=False):
            layout += [(count, bits), (2 * count, bits - CHROMA_FEWER)]
        return layout
