"""The quantised values that carry bits, how many each (docs/byte-layout.md), and in which order.

A *level* is an integer that grows with the number it stands for; a *field* is one coordinate of an attribute
of all Gaussians. The number of bits that a level carries follows from values that are never written: for
positions from the Gaussian's size and the format's step, so that they move by a fraction of that size. The
arithmetic is the same on every machine and uses no logarithms: a reader must find the same numbers of bits.

Writing matches levels (Sharp 2001) instead of overwriting their bits. Overwriting moves even levels up and
odd ones down only, which makes pairs of them equally frequent: the attacks of Westfeld and Pfitzmann (1999)
and of Fridrich et al. (2001) find that.

Bits are counted in the order of the file, except those of a .sog. A .sog is sorted by positions, which carry
bits, so its bits are counted in the order of hashes of the values that carry none.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from keyss.channels.mixing import row_hashes
from keyss.core.arrays import Bytes, Doubles, Flags, Floats, Integers, Numbers, Words, repeated
from keyss.core.gaussians import Gaussians
from keyss.files.formats.common import Codes, morton_order
from keyss.files.formats.compressed_ply import CHUNK, CompressedPlyCodes
from keyss.files.formats.sog import SogCodes
from keyss.files.formats.spz import SpzCodes

Levels = npt.NDArray[np.int32]

# Levels of -sqrt(1/2) and sqrt(1/2), the range of a rotation's components, in each format.
ROTATIONS: dict[type[Codes], tuple[int, int]] = {
    SpzCodes: (-511, 511),
    SogCodes: (0, 255),
    CompressedPlyCodes: (0, 1023),
}
QUANTISED = {rotation.name: rotation for rotation in ROTATIONS}
MAX_BITS = 10
_POSITION_RANGE = -3.0  # log2 of the range of written positions, in sizes of the Gaussian
LOG_SCALE_RANGE = -4.0  # log2 of the range of written log scales
_SIGN, _MAGNITUDE = 512, 511  # masks of a rotation's component in SPZ 3 and newer
_LOG2_E = 1.4426950408889634
_VECTOR = np.array([2047, 1023, 2047])  # largest levels of x, y, z in a compressed .ply
_SOG_ARRAYS = ("positions", "largest", "rotations", "scales", "colors", "alphas", "labels")


@dataclass(frozen=True)
class Field:
    """One coordinate of an attribute of N Gaussians."""

    name: str  # name of the attribute in the codes
    column: int
    levels: Levels  # [N]
    bits: Levels  # [N] bits that each level carries, 0 to MAX_BITS

    def read(self) -> Bytes:
        """[B] the last bits of all levels, the lowest first."""
        bits = self.levels[:, None] >> np.arange(MAX_BITS, dtype=np.int32) & 1
        return bits[self._places()].astype(np.uint8)

    @property
    def reach(self) -> Levels:
        """[N] maximum change of each level by `with_bits`."""
        return (1 << self.bits) // 2

    def with_bits(self, bits: Bytes, ties: Doubles) -> Levels:
        """[N] the nearest levels from which `read` gives `bits` [B].

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


def with_levels(codes: Any, levels: Mapping[str, Levels]) -> Any:
    """`codes` with new levels [N, C] of some attributes."""
    written = dict(levels)
    if isinstance(codes, SpzCodes) and "rotations" in levels:
        signed = levels["rotations"]
        negative: Flags = (signed < 0) | ((signed == 0) & (codes.rotations & _SIGN > 0))  # there is a -0
        written["rotations"] = np.abs(signed) + _SIGN * negative.astype(np.int32)
    old = {name: getattr(codes, name) for name in levels}
    return replace(
        codes,
        **{name: written[name].reshape(levels.shape).astype(levels.dtype) for name, levels in old.items()},
    )


def sog_distances(codes: SogCodes, levels: Numbers) -> Integers:
    """[N, 3] log2 of the step of a .sog at these `levels` of positions, relative to the step at 0."""
    logs = np.abs(codes.mins + _extent(codes) * (levels / 65535))  # ln(1 + |coordinate|)
    return np.floor(logs * _LOG2_E).clip(0, 64).astype(np.int64)


def last_bits(fields: Sequence[Field]) -> Bytes:
    """The last bits of all levels, field after field."""
    return np.concatenate([field.read() for field in fields])


def in_counted_order(codes: Codes, exact: Flags | None = None) -> tuple[Integers, Any, list[Field]]:
    """The order [N] in which bits are counted, the codes in this order, and their fields.

    Gaussians that are not `exact` [N] (see `Decoded`) and those of a .sog with equal hashes carry no bits.
    """
    rows = np.arange(len(codes))
    silent = np.zeros(len(codes), np.bool_) if exact is None else ~exact
    if isinstance(codes, SogCodes):
        hashes = _sog_hashes(codes)
        rows, silent = np.argsort(hashes, kind="stable"), silent | repeated(hashes)
    codes, silent = in_rows(codes, rows), silent[rows]
    fields = [replace(field, bits=np.where(silent, 0, field.bits)) for field in _fields_of(codes)]
    return rows, codes, fields


def model_hash(codes: Any, decoded: Gaussians | None = None) -> bytes:
    """12 bytes of a hash of colours and opacities, which never change: those of `decoded`, else of `codes`.

    It binds blocks to their model: blocks copied into another one open nothing. Gaussians are in counted
    order, without those of a .sog with equal hashes, whose order is undefined.
    """
    if decoded is None:
        words = np.column_stack([codes.colors, codes.alphas]).astype("<u4")
    else:
        words = torch.column_stack([decoded.sh[:, 0], decoded.opacity_logits]).float().numpy().view("<u4")
    if isinstance(codes, SogCodes):
        words = words[~repeated(_sog_hashes(codes))]
    return hashlib.sha256(b"keyss/v1/host" + words.tobytes()).digest()[:12]


def file_order(codes: Codes, within: Doubles) -> Integers:
    """The rows [N] as a writer of the format stores them.

    Writers sort before they round, so a few neighbours seem out of order. `within` [N, 3]: random rounding
    errors in [-0.5, 0.5], in levels; extremes have none.
    """
    if not isinstance(codes, SogCodes):
        return np.arange(len(codes))
    levels = codes.positions
    extreme = (levels == levels.min(axis=0)) | (levels == levels.max(axis=0))
    means: Floats = codes.positions_at(levels + np.where(extreme, 0.0, within)).astype(np.float32)
    return morton_order(means)


def in_rows(codes: Codes, rows: Integers) -> Any:
    """The Gaussians of `codes` in the order `rows` [N]; formats other than .sog keep theirs."""
    if not isinstance(codes, SogCodes):
        return codes
    return replace(codes, **{name: getattr(codes, name)[rows] for name in _SOG_ARRAYS})


def _sog_hashes(codes: SogCodes) -> Words:
    """[N] hashes of the values that are never written."""
    parts = (codes.scales, codes.colors, codes.alphas, codes.labels, codes.largest)
    levels = sog_distances(codes, codes.positions)
    return row_hashes(np.concatenate([part.reshape(len(levels), -1) for part in (*parts, levels)], axis=1))


def _fields_of(codes: Codes) -> list[Field]:
    """The fields of `codes`. Rotations of SPZ 2 carry nothing."""
    if isinstance(codes, SpzCodes):
        sizes = (_medians(codes.scales) / 16 - 10) * _LOG2_E
        bits = _fitting(sizes[:, None] + codes.fractional_bits + _POSITION_RANGE)
        positions = _fields("positions", codes.positions, bits)
        if codes.version == 2:
            return positions
        rotations = codes.rotations.astype(np.int32)
        magnitudes = rotations & _MAGNITUDE
        return positions + _fields("rotations", np.where(rotations > _MAGNITUDE, -magnitudes, magnitudes), 3)
    if isinstance(codes, SogCodes):
        sizes = _medians(codes.scale_codebook.astype(np.float64)[codes.scales]) * _LOG2_E
        steps = _log2(_extent(codes) / 65535) + sog_distances(codes, codes.positions) + 0.5
        bits = _fitting(sizes[:, None] + _POSITION_RANGE - steps)
        return _fields("positions", codes.positions, bits) + _fields("rotations", codes.rotations, 2)
    assert isinstance(codes, CompressedPlyCodes)
    low, high = codes.bounds[:, 6:9].astype(np.float64), codes.bounds[:, 9:12].astype(np.float64)
    bits = _fitting(LOG_SCALE_RANGE - _log2((high - low) / _VECTOR)).repeat(CHUNK, axis=0)[: len(codes)]
    return _fields("scales", codes.scales, bits) + _fields("rotations", codes.rotations, 3)


def _extent(codes: SogCodes) -> Doubles:
    return np.where(codes.maxs > codes.mins, codes.maxs - codes.mins, 1.0)


def _medians(values: Numbers) -> Doubles:
    """[N] medians of rows [N, 3]."""
    return np.sort(values.astype(np.float64), axis=1)[:, 1]


def _log2(values: Doubles) -> Doubles:
    """Approximate log2, too small by up to 0.09: linear between powers of 2."""
    mantissa, exponent = np.frexp(values)
    logarithms: Doubles = exponent + 2 * (mantissa - 1)
    return logarithms


def _fitting(logs: Doubles) -> Levels:
    """The number of bits of levels that span at most 2 ** `logs`."""
    return np.floor(np.nan_to_num(logs)).clip(0, MAX_BITS).astype(np.int32)


def _fields(name: str, levels: Numbers, bits: Levels | int) -> list[Field]:
    """A field of each column [N, C]."""
    signed = levels.astype(np.int32)
    each_column = zip(signed.T, np.broadcast_to(np.int32(bits), signed.shape).T, strict=True)
    return [Field(name, index, *arrays) for index, arrays in enumerate(each_column)]
