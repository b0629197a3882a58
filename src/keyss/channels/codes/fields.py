"""Which numbers of a format's codes carry bits, and how many each: measured, see docs/codes.md.

A *level* is an integer that grows with what it stands for; a *field* is one coordinate of an attribute of all
Gaussians. Which of its levels are usable follows from what writing leaves as it is: the ends of a range are
left alone and never moved to, so that saturated values, extremes, and fields of one value stay.

Positions stay in cells of as many levels as there are residues, 16 or 32, so that Gaussians can be told
apart, and put in an order, by these. That is overwriting, but so evenly do positions lie within a cell that
their frequencies stay the same; where they do not, a field is left alone (see `natural`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from keyss.core.errors import InputError
from keyss.files.formats.common import Codes, Floats
from keyss.files.formats.compressed_ply import CompressedPlyCodes
from keyss.files.formats.sog import SogCodes
from keyss.files.formats.spz import SpzCodes

Levels = npt.NDArray[np.int32]
Flags = npt.NDArray[np.bool_]

_SIGN, _MAGNITUDE = 512, 511  # of SPZ's rotations
_FAR_COLORS = 0.12  # numbers of a codebook of colours further apart than this are no neighbours
_LEAST_RUN = 8  # of neighbours in a codebook; in shorter runs levels could hardly go both ways


@dataclass(frozen=True)
class Field:
    """One coordinate of an attribute of N Gaussians."""

    name: str  # of the attribute in the codes
    column: int
    bits: int  # that a level carries
    levels: Levels  # [N]
    low: Levels  # [N] smallest that may be written
    high: Levels  # [N] largest that may be written
    usable: Flags  # [N] which levels carry

    @property
    def room(self) -> int:
        """Bits of all levels together."""
        return int(np.count_nonzero(self.usable)) * self.bits


@dataclass(frozen=True)
class Format:
    """How codes of one kind carry."""

    name: str  # as users know it
    bits: Mapping[str, int]  # of a level of each attribute
    levels: Callable[[Any], list[Field]]
    with_levels: Callable[[Any, Mapping[str, Levels]], Any]  # codes with new levels of some fields
    # A level of a rotation stands for (level - first) * second; None: what is not stored need not be largest.
    turns: Callable[[Any], tuple[float, float] | None]


def format_of(codes: Codes) -> Format:
    """How these codes carry. Raises InputError for formats whose codes do not."""
    if type(codes) not in _FORMATS:
        raise InputError(f"nothing can be carried in the codes of this format: expected {', '.join(NAMES)}")
    return _FORMATS[type(codes)]


def position_cells(codes: SogCodes | SpzCodes) -> npt.NDArray[np.integer[Any]]:
    """[N, 3] which cells the positions lie in, whatever is written."""
    return codes.positions >> format_of(codes).bits["positions"]


def fields_of(codes: Codes) -> list[Field]:
    """The fields that carry; the first one holds salt and headers, too."""
    return format_of(codes).levels(codes)


def _spz_fields(codes: SpzCodes) -> list[Field]:
    bits, end = SPZ.bits["rotations"], _MAGNITUDE
    rotations: Levels = codes.rotations.astype(np.int32)
    least = -end
    if codes.version == 2:
        bits, least, end = 1, 0, 255
    else:
        magnitudes = rotations & _MAGNITUDE
        rotations = np.where(rotations > _MAGNITUDE, -magnitudes, magnitudes).astype(np.int32)
    return [
        *_within_cells("positions", SPZ.bits["positions"], codes.positions),
        *_between("rotations", bits, rotations, least, end),
        *_within_columns("colors", SPZ.bits["colors"], codes.colors),
        *_within_columns("alphas", SPZ.bits["alphas"], codes.alphas[:, None]),
    ]


def _spz_with_levels(codes: SpzCodes, levels: Mapping[str, Levels]) -> SpzCodes:
    found = dict(levels)
    if "rotations" in found and codes.version > 2:
        signed = found["rotations"]
        negative: Flags = (signed < 0) | ((signed == 0) & (codes.rotations & _SIGN > 0))  # there is a -0
        found["rotations"] = np.abs(signed) + _SIGN * negative.astype(np.int32)
    replaced: SpzCodes = _replaced(codes, found)
    return replaced


def _sog_fields(codes: SogCodes) -> list[Field]:
    return [
        *_within_cells("positions", SOG.bits["positions"], codes.positions),
        *_between("rotations", SOG.bits["rotations"], codes.rotations, 0, 255),
        *_of_codebook("colors", SOG.bits["colors"], codes.colors, codes.color_codebook, _FAR_COLORS),
        *_within_columns("alphas", SOG.bits["alphas"], codes.alphas[:, None]),
    ]


def _compressed_ply_fields(codes: CompressedPlyCodes) -> list[Field]:
    bits = COMPRESSED_PLY.bits
    return [
        *_between("scales", bits["scales"], codes.scales, 0, np.array([2047, 1023, 2047], np.int32)),
        *_between("rotations", bits["rotations"], codes.rotations, 0, 1023),
        *_between("colors", bits["colors"], codes.colors, 0, 255),
        *_within_columns("alphas", bits["alphas"], codes.alphas[:, None]),
    ]


def _replaced(codes: Any, levels: Mapping[str, Levels]) -> Any:
    """`codes` with levels that are codes."""
    old = {name: getattr(codes, name) for name in levels}
    return replace(
        codes, **{name: levels[name].reshape(each.shape).astype(each.dtype) for name, each in old.items()}
    )


def _spz_turns(codes: SpzCodes) -> tuple[float, float] | None:
    return (0.0, 0.5**0.5 / _MAGNITUDE) if codes.version > 2 else None


SPZ = Format(
    "spz",
    {"positions": 4, "rotations": 2, "colors": 1, "alphas": 1},
    _spz_fields,
    _spz_with_levels,
    _spz_turns,
)
SOG = Format(
    "sog",
    {"positions": 5, "rotations": 1, "colors": 1, "alphas": 1},
    _sog_fields,
    _replaced,
    lambda codes: (127.5, 2**0.5 / 255),
)
COMPRESSED_PLY = Format(
    "compressed-ply",
    {"scales": 4, "rotations": 2, "colors": 1, "alphas": 1},
    _compressed_ply_fields,
    _replaced,
    lambda codes: (511.5, 2**0.5 / 1023),
)
_FORMATS: dict[type[Codes], Format] = {SpzCodes: SPZ, SogCodes: SOG, CompressedPlyCodes: COMPRESSED_PLY}
NAMES = tuple(each.name for each in _FORMATS.values())


def _between(name: str, bits: int, levels: npt.NDArray[Any], least: Any, most: Any) -> list[Field]:
    """Levels between the ends of what the format holds, or those of each column."""
    low, high = (np.broadcast_to(np.asarray(each, np.int32), levels.shape) for each in (least, most))
    return _fields(name, bits, levels, low + np.int32(1), high - np.int32(1))


def _within_columns(name: str, bits: int, levels: npt.NDArray[Any]) -> list[Field]:
    """Levels between the extremes of their columns."""
    return _between(name, bits, levels, levels.min(axis=0), levels.max(axis=0))


def _within_cells(name: str, bits: int, levels: npt.NDArray[Any]) -> list[Field]:
    """Levels that stay in their cell, and none of the cells in which the extremes of the columns lie."""
    size = 1 << bits
    cells = levels.astype(np.int32) // size
    inside = (cells > cells.min(axis=0)) & (cells < cells.max(axis=0))
    return _fields(name, bits, levels, cells * size, cells * size + (size - 1), inside)


def _of_codebook(name: str, bits: int, levels: npt.NDArray[Any], codebook: Floats, far: float) -> list[Field]:
    """Indices into an ascending codebook, within runs of numbers that are near each other and differ."""
    gaps = np.diff(codebook.astype(np.float64))
    cut = np.concatenate([[True], ~((gaps > 0) & (gaps <= far)), [True]])  # before each, and after the last
    at = np.arange(len(codebook), dtype=np.int32)
    first = np.maximum.accumulate(np.where(cut[:-1], at, 0))
    last = np.minimum.accumulate(np.where(cut[1:], at, len(codebook))[::-1])[::-1]
    low, high = first[levels].astype(np.int32), last[levels].astype(np.int32)
    return _fields(name, bits, levels, low, high, high - low >= _LEAST_RUN - 1)


def _fields(
    name: str, bits: int, levels: npt.NDArray[Any], low: Levels, high: Levels, usable: Flags | None = None
) -> list[Field]:
    """A field of each column [N, C]; usable are levels from `low` to `high`, if all residues lie there."""
    own = levels.astype(np.int32)
    inside: Flags = (own >= low) & (own <= high) & (high - low >= (1 << bits) - 1)
    if usable is not None:
        inside &= usable
    each_column = zip(own.T, low.T, high.T, inside.T, strict=True)
    return [Field(name, index, bits, *arrays) for index, arrays in enumerate(each_column)]
