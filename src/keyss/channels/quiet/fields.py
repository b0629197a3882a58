"""The numbers of a format's codes that carry bits, and how many bits each (measured: docs/channels.md).

A *level* is an integer that grows with the number it stands for; a *field* is one coordinate of an attribute
of all Gaussians. The number of bits that a level carries follows from codes that are never written: from the
Gaussian's size and the format's step, so that positions move by a fraction of that size. The arithmetic is
the same on every machine and uses no logarithms: a reader must find the same numbers of bits.

Writing matches levels (Sharp 2001) instead of overwriting their bits. Overwriting moves even levels up and
odd ones down only, which makes pairs of them equally frequent: the attacks of Westfeld and Pfitzmann (1999)
and of Fridrich et al. (2001) find that.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from keyss.core.arrays import Bytes, Doubles, Flags, Integers, Numbers
from keyss.files.formats.common import Codes
from keyss.files.formats.compressed_ply import CHUNK, CompressedPlyCodes
from keyss.files.formats.sog import SogCodes
from keyss.files.formats.spz import SpzCodes

Levels = npt.NDArray[np.int32]

MAX_BITS = 10
_SHARE = -3.0  # log2 of the range of written positions, in sizes of the Gaussian
LOG_SCALE_RANGE = -4.0  # log2 of the range of written log scales
_SIGN, _MAGNITUDE = 512, 511  # masks of a rotation's component in SPZ 3 and newer
_LOG2_E = 1.4426950408889634
_VECTOR = np.array([2047, 1023, 2047])  # largest levels of x, y, z in a compressed .ply


@dataclass(frozen=True)
class Field:
    """One coordinate of an attribute of N Gaussians."""

    name: str  # name of the attribute in the codes
    column: int
    levels: Levels  # [N]
    bits: Levels  # [N] bits that each level carries, 0 to MAX_BITS

    @property
    def total_bits(self) -> int:
        """Bits of all levels together."""
        return int(self.bits.sum())

    def read(self) -> Bytes:
        """[total_bits] the last bits of all levels, the lowest first."""
        bits = self.levels[:, None] >> np.arange(MAX_BITS, dtype=np.int32) & 1
        return bits[self._places()].astype(np.uint8)

    @property
    def reach(self) -> Levels:
        """[N] maximum change of each level by `with_bits`."""
        return (1 << self.bits) // 2

    def with_bits(self, bits: Bytes, ties: Doubles) -> Levels:
        """[N] the nearest levels from which `read` gives `bits` [total_bits].

        `ties` [N] in [-0.5, 0.5]: break ties between equally near levels.
        """
        places = np.zeros((len(self.levels), MAX_BITS), np.int32)
        places[self._places()] = bits
        residues = places @ (1 << np.arange(MAX_BITS, dtype=np.int32))
        step = 1 << self.bits
        matched: Levels = (residues + step * ((self.levels + ties - residues) / step).round()).astype("int32")
        return matched

    def _places(self) -> Flags:
        return np.arange(MAX_BITS) < self.bits[:, None]


@dataclass(frozen=True)
class Carrying:
    """How the codes of one format carry bits."""

    fields: Callable[[Any], list[Field]]
    with_levels: Callable[[Any, Mapping[str, Levels]], Any]  # codes with new levels of some fields
    # Levels of -sqrt(1/2) and sqrt(1/2), the range of a rotation's components.
    rotations: tuple[int, int]


def carrying(codes: Codes) -> Carrying:
    """How the format of these codes carries bits."""
    return _CARRYING[type(codes)]


def sog_distances(codes: SogCodes, levels: Numbers) -> Integers:
    """[N, 3] log2 of the step of a .sog at these `levels` of positions, relative to the step at 0."""
    extent = np.where(codes.maxs > codes.mins, codes.maxs - codes.mins, 1.0)
    logs = np.abs(codes.mins + extent * (levels / 65535))  # ln(1 + |coordinate|)
    return np.floor(logs * _LOG2_E).clip(0, 64).astype(np.int64)


def last_bits(fields: Sequence[Field]) -> Bytes:
    """The last bits of all levels, field after field."""
    return np.concatenate([each.read() for each in fields])


def _spz_fields(codes: SpzCodes) -> list[Field]:
    """Rotations of version 2, which no program writes any more, carry nothing."""
    sizes = (_medians(codes.scales) / 16 - 10) * _LOG2_E
    bits = _fitting(sizes[:, None] + codes.fractional_bits + _SHARE)
    positions = _fields("positions", codes.positions, bits)
    if codes.version == 2:
        return positions
    rotations = codes.rotations.astype(np.int32)
    magnitudes = rotations & _MAGNITUDE
    signed = np.where(rotations > _MAGNITUDE, -magnitudes, magnitudes)
    return [*positions, *_fields("rotations", signed, 3)]


def _spz_with_levels(codes: SpzCodes, levels: Mapping[str, Levels]) -> SpzCodes:
    replaced = dict(levels)
    if "rotations" in levels:
        signed = levels["rotations"]
        negative: Flags = (signed < 0) | ((signed == 0) & (codes.rotations & _SIGN > 0))  # there is a -0
        replaced["rotations"] = np.abs(signed) + _SIGN * negative.astype(np.int32)
    return _replaced(codes, replaced)  # type: ignore[no-any-return]


def _sog_fields(codes: SogCodes) -> list[Field]:
    sizes = _medians(codes.scale_codebook.astype(np.float64)[codes.scales]) * _LOG2_E
    extent = np.where(codes.maxs > codes.mins, codes.maxs - codes.mins, 1.0)
    steps = _log2(extent / 65535) + sog_distances(codes, codes.positions) + 0.5
    return [
        *_fields("positions", codes.positions, _fitting(sizes[:, None] + _SHARE - steps)),
        *_fields("rotations", codes.rotations, 2),
    ]


def _compressed_ply_fields(codes: CompressedPlyCodes) -> list[Field]:
    low, high = codes.bounds[:, 6:9].astype(np.float64), codes.bounds[:, 9:12].astype(np.float64)
    bits = _fitting(LOG_SCALE_RANGE - _log2((high - low) / _VECTOR)).repeat(CHUNK, axis=0)[: len(codes)]
    return [*_fields("scales", codes.scales, bits), *_fields("rotations", codes.rotations, 3)]


def _replaced(codes: Any, levels: Mapping[str, Levels]) -> Any:
    """`codes` with new levels, in formats whose levels are the codes themselves."""
    old = {name: getattr(codes, name) for name in levels}
    return replace(
        codes, **{name: levels[name].reshape(each.shape).astype(each.dtype) for name, each in old.items()}
    )


_CARRYING: dict[type[Codes], Carrying] = {
    SpzCodes: Carrying(_spz_fields, _spz_with_levels, (-511, 511)),
    SogCodes: Carrying(_sog_fields, _replaced, (0, 255)),
    CompressedPlyCodes: Carrying(_compressed_ply_fields, _replaced, (0, 1023)),
}
FORMATS = {each.name: each for each in _CARRYING}


def _medians(values: Numbers) -> Doubles:
    """[N] medians of rows [N, 3]."""
    return np.sort(values.astype(np.float64), axis=1)[:, 1]


def _log2(values: Doubles) -> Doubles:
    """Approximate log2, too small by up to 0.09: linear between powers of 2."""
    mantissa, exponent = np.frexp(values)
    found: Doubles = exponent + 2 * (mantissa - 1)
    return found


def _fitting(logs: Doubles) -> Levels:
    """The number of bits of levels that span at most 2 ** `logs`."""
    return np.floor(np.nan_to_num(logs)).clip(0, MAX_BITS).astype(np.int32)


def _fields(name: str, levels: Numbers, bits: Levels | int) -> list[Field]:
    """A field of each column [N, C]."""
    own = levels.astype(np.int32)
    each_column = zip(own.T, np.broadcast_to(np.int32(bits), own.shape).T, strict=True)
    return [Field(name, index, *arrays) for index, arrays in enumerate(each_column)]
