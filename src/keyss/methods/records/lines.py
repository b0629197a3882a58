"""Lines that numbers are coded on, and those that suit given numbers; see `quantise`."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Codes = npt.NDArray[np.uint32]

_TAIL = 0.05  # share of the numbers that says nothing of how far the bulk reaches, on each side if both count
_EVEN_MARGIN = 0.75  # on a line divided evenly the bulk's neighbourhood ends as many of its widths from it
_FAR = 8.0  # on one by asinh it ends at as many times the bulk's distance from the median
_FURTHEST = 1e30  # no value that a line may give is larger
_MIN_SPREAD = 1e-9
_HALF = 1e-3  # half precision rounds by less than this share
LINE = struct.Struct("<2f2e")  # centre, spread, reach, reach of outliers
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
        return self.codes(self.positions(values), bits)

    def positions(self, values: Floats) -> Floats:
        """Where values lie, whatever the reach is."""
        offset: Floats = values - self.centre
        return np.arcsinh(offset / self.spread) if self.spread > 0 else offset

    def codes(self, position: Floats, bits: int) -> Codes:
        """`encode` of values at these positions."""
        last = (1 << bits) - 1
        codes = np.rint((position / self.reach + 1) * (last / 2)).clip(0, last)
        return codes.astype(np.uint32)

    def decode(self, codes: Codes, bits: int) -> Floats:
        """The values that codes stand for."""
        position = (codes.astype(np.float64) * (2 / ((1 << bits) - 1)) - 1) * self.reach
        offset: Floats = np.sinh(position) * self.spread if self.spread > 0 else position
        return offset + self.centre


class Kind(NamedTuple):
    """What suits the numbers of one kind."""

    even: bool = False  # whether their line is divided evenly, else by asinh
    clips: bool = False  # whether the furthest of the bulk may be clipped
    centred: bool = False  # whether zero is the centre


EVEN, POSITION = Kind(even=True), Kind()
COLOUR, HARMONIC = Kind(clips=True), Kind(clips=True, centred=True)


class Extent(NamedTuple):
    """How far the numbers of a line reach."""

    least: float
    largest: float

    @staticmethod
    def of(values: Floats) -> Extent:
        """Of all values; there may be none."""
        return Extent(float(values.min(initial=np.inf)), float(values.max(initial=-np.inf)))

    def from_centre(self, centre: float) -> float:
        """The largest distance of a number from `centre`; 0 where there are none."""
        return max(self.largest - centre, centre - self.least, 0.0)


def neighbourhood(values: Floats, kind: Kind) -> tuple[float, float]:
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


def fitted(kind: Kind, bits: int, sample: Floats, extent: Extent, centre: float, spread: float) -> Line:
    """The line for the numbers of the bulk.

    `sample`: some of them; `extent`: of all; `centre`: their median, or 0 for `kind.centred`; `spread`: their
    mean distance from it. The last two do not matter on a line divided evenly.
    """
    if kind.even:
        return _line((extent.least + extent.largest) / 2, 0, (extent.largest - extent.least) / 2)
    spread = max(spread, _MIN_SPREAD)
    if kind.clips:
        return _best_line(sample, bits, extent.from_centre(centre) or 1.0, centre, spread)
    return reaching(_line(centre, spread, 1), extent)


def reaching(line: Line, extent: Extent) -> Line:
    """`line` with such a reach that all values lie on it."""
    furthest = extent.from_centre(line.centre)
    reach = np.arcsinh(furthest / line.spread) if line.spread > 0 else furthest
    return _line(line.centre, line.spread, float(reach))


def _best_line(sample: Floats, bits: int, furthest: float, centre: float, spread: float) -> Line:
    """Of some lines that reach to the furthest value or less far the one with the least error."""
    best, least = _line(centre, spread, float(np.arcsinh(furthest / spread))), np.inf
    every = np.arange(1 << bits, dtype=np.uint32)
    for scale in (0.5, 1.0, 2.0, 4.0):
        positions = _line(centre, scale * spread, 1.0).positions(sample)
        for reach in np.geomspace(min(0.5 * spread, furthest), furthest, 12):
            line = _line(centre, scale * spread, float(np.arcsinh(reach / (scale * spread))))
            codes = line.codes(positions, bits)
            some = len(every) < len(codes)  # fewer hyperbolic sines
            error = (line.decode(every, bits)[codes] if some else line.decode(codes, bits)) - sample
            shrinking = float((error * (sample - centre)).mean()) ** 2 / spread**2
            cost = float(np.square(error).mean()) + _SHRINKING_WEIGHT * shrinking
            if cost < least:
                best, least = line, cost
    return best


def _line(centre: float, spread: float, reach: float) -> Line:
    """A line whose numbers are as precise as they are stored, and that is longer than a point."""
    return Line(*LINE.unpack(LINE.pack(centre, spread, max(reach * (1 + _HALF), _HALF), 0))[:3])
