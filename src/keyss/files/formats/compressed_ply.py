"""Compressed .ply, PlayCanvas's format: 16 bytes and 8-bit harmonics per Gaussian, in chunks of 256.

https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/ply/#compressed-ply. Positions, log
scales and colours are quantised between the bounds of their chunk, so `write` sorts Gaussians spatially.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from keyss.core.arrays import Bytes, Doubles, Floats, Numbers, Shorts, Words32
from keyss.core.errors import InputError
from keyss.core.gaussians import SH_C0, Gaussians
from keyss.files.formats.common import (
    Codes,
    arrays_of,
    f_dc_of,
    from_smallest_three,
    gaussians_of,
    smallest_three,
    to_bytes,
)
from keyss.files.ply_table import ply_header, read_tables

CHUNK = 256  # Gaussians
VECTOR = (11, 10, 11)  # bits of x, y, z
_SCALE_LIMIT = 20.0  # log scales are clipped to +- this
_MIN_RANGE = 1e-5  # in chunks of smaller range, all values become the lower bound

_BOUNDS = [
    f"{end}_{name}"
    for names in ("x y z", "scale_x scale_y scale_z", "r g b")
    for end in ("min", "max")
    for name in names.split()
]
_COLOR_BOUNDS = np.repeat(np.array([0, 1], np.float32), 3)  # defaults of files without colour bounds
_PACKED = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]


@dataclass(frozen=True, eq=False)
class CompressedPlyCodes(Codes):
    """All values of a file; Gaussian i is in chunk i // 256."""

    name = "compressed-ply"

    bounds: Floats  # [C, 18] min, then max of x y z; log scales; r g b (f_dc * SH_C0 + 0.5)
    positions: Shorts  # [N, 3] 11, 10 and 11 bits, between the bounds
    largest: Bytes  # [N] index of the component of wxyz left out
    rotations: Shorts  # [N, 3] components that are stored, 10 bits each, from -sqrt(1/2) to sqrt(1/2)
    scales: Shorts  # [N, 3] 11, 10 and 11 bits, between the bounds
    colors: Bytes  # [N, 3] between the bounds
    alphas: Bytes  # [N] opacities in 255ths
    sh: Bytes  # [N, K - 1, 3] harmonics in 32nds from -4 on
    comments: tuple[str, ...] = ()  # whole lines of the header

    @classmethod
    def parse(cls, data: bytes) -> Self:
        tables, comments = read_tables(io.BytesIO(data))
        vertex, chunk = tables["vertex"], tables.get("chunk")
        n = len(vertex)
        if chunk is None or not _has(vertex, _PACKED, "u4") or not _has(chunk, _BOUNDS[:12], "f4"):
            raise InputError(
                "not a compressed .ply: expected chunks of floats and vertices of packed integers"
            )
        if n == 0:
            raise InputError("it holds no Gaussians")
        if len(chunk) != -(-n // CHUNK):
            raise InputError(f"expected {-(-n // CHUNK):,} chunks of {n:,} Gaussians, found {len(chunk):,}")
        bounds = np.tile(_COLOR_BOUNDS, (len(chunk), 3))
        for column, name in enumerate(_BOUNDS if _has(chunk, _BOUNDS, "f4") else _BOUNDS[:12]):
            bounds[:, column] = chunk[name]
        position, rotation, scale, color = (vertex[name].astype(np.uint32) for name in _PACKED)
        return cls(
            bounds=bounds,
            positions=_unpack_fields(position, VECTOR).astype(np.uint16),
            largest=(rotation >> 30).astype(np.uint8),
            rotations=_unpack_fields(rotation, (10, 10, 10)).astype(np.uint16),
            scales=_unpack_fields(scale, VECTOR).astype(np.uint16),
            colors=_unpack_fields(color >> 8, (8, 8, 8)).astype(np.uint8),
            alphas=(color & 255).astype(np.uint8),
            sh=_harmonics(tables.get("sh"), n),
            comments=tuple(comments),
        )

    def serialise(self) -> bytes:
        n, k = self.sh.shape[:2]
        packed = np.empty((n, 4), dtype="<u4")
        packed[:, 0] = _pack_fields(self.positions, VECTOR)
        packed[:, 1] = self.largest.astype(np.uint32) << 30 | _pack_fields(self.rotations, (10, 10, 10))
        packed[:, 2] = _pack_fields(self.scales, VECTOR)
        packed[:, 3] = _pack_fields(self.colors, (8, 8, 8)) << np.uint32(8) | self.alphas
        has_colors = bool((self.bounds[:, 12:] != _COLOR_BOUNDS).any())  # optional
        names = _BOUNDS if has_colors else _BOUNDS[:12]
        elements = {
            "chunk": (len(self.bounds), [f"float {name}" for name in names]),
            "vertex": (n, [f"uint {name}" for name in _PACKED]),
        }
        if k:
            elements["sh"] = (n, [f"uchar f_rest_{i}" for i in range(3 * k)])
        harmonics = self.sh.transpose(0, 2, 1).tobytes()
        bounds = self.bounds[:, : len(names)].astype("<f4").tobytes()
        return ply_header(elements, self.comments) + bounds + packed.tobytes() + harmonics

    @classmethod
    def quantise(cls, model: Gaussians) -> Self:
        means, quats, log_scales, opacities, f_dc, rest = arrays_of(model)
        colors = f_dc.astype(np.float64) * SH_C0 + 0.5
        parts = [means.astype(np.float64), log_scales.astype(np.float64), colors]
        starts, ends = np.arange(0, len(model), CHUNK), (np.minimum, np.maximum)
        bounds = np.concatenate([end.reduceat(part, starts) for part in parts for end in ends], axis=1)
        bounds[:, 6:12] = bounds[:, 6:12].clip(-_SCALE_LIMIT, _SCALE_LIMIT)
        bounds = bounds.astype(np.float32)
        between = bounds.astype(np.float64).repeat(CHUNK, axis=0)[: len(model)].reshape(-1, 3, 2, 3)
        position, scale, color = (_inverse_lerp(between[:, i], values) for i, values in enumerate(parts))
        largest, others = smallest_three(quats)
        steps = 2.0 ** np.array(VECTOR) - 1
        return cls(
            bounds=bounds,
            positions=np.floor(position * steps + 0.5).astype(np.uint16),
            largest=largest,
            rotations=to_bytes((others * np.sqrt(0.5) + 0.5) * 1023, 1023),
            scales=np.floor(scale * steps + 0.5).astype(np.uint16),
            colors=to_bytes(color * 255),
            alphas=to_bytes(opacities * 255),
            sh=to_bytes(np.trunc((rest.astype(np.float64) / 8 + 0.5) * 256)),
        )

    def decode_part(self, part: slice) -> Gaussians:
        chunks = self.bounds[part.start // CHUNK : -(-part.stop // CHUNK)].astype(np.float64)
        bounds = chunks.repeat(CHUNK, axis=0)[: part.stop - part.start].reshape(-1, 3, 2, 3)
        steps = 2.0 ** np.array(VECTOR) - 1
        rotations, sh = (self.rotations[part] / 1023 - 0.5) * np.sqrt(2), self.sh[part]
        harmonics = np.where(sh == 0, 0.0, np.where(sh == 255, 256.0, sh + 0.5))
        return gaussians_of(
            _lerp(bounds[:, 0], self.positions[part] / steps),
            from_smallest_three(self.largest[part], rotations),
            _lerp(bounds[:, 1], self.scales[part] / steps),
            self.alphas[part] / 255,
            f_dc_of(_lerp(bounds[:, 2], self.colors[part] / 255)),
            harmonics / 32 - 4,
        )


def _has(table: npt.NDArray[np.void], names: list[str], code: str) -> bool:
    types: Mapping[str, Any] = table.dtype.fields or {}
    return all(name in types and types[name][0].newbyteorder("=") == np.dtype(code) for name in names)


def _harmonics(table: npt.NDArray[np.void] | None, n: int) -> Bytes:
    """[N, K - 1, 3] codes of the channel-major element `sh`; K = 1 without it."""
    if table is None:
        return np.empty((n, 0, 3), np.uint8)
    names = list(table.dtype.names or ())
    if names != [f"f_rest_{i}" for i in range(len(names))] or len(names) not in (9, 24, 45):
        raise InputError(f"expected 9, 24 or 45 properties f_rest_0, f_rest_1, ..., found {len(names)}")
    if len(table) != n or not _has(table, names, "u1"):
        raise InputError(f"expected one byte for each harmonic of {n:,} Gaussians, found something else")
    return np.ascontiguousarray(table).view(np.uint8).reshape(n, 3, -1).transpose(0, 2, 1).copy()


def _unpack_fields(packed: Numbers, bits: tuple[int, int, int]) -> Words32:
    """[N, 3] three bit fields of `packed` [N]; the last field has the lowest bits."""
    shifts = np.array([bits[1] + bits[2], bits[2], 0], dtype=np.uint32)
    return packed[:, None] >> shifts & (2 ** np.array(bits, np.uint32) - np.uint32(1))


def _pack_fields(values: Numbers, bits: tuple[int, int, int]) -> Words32:
    """[N] integers from bit fields, inverse of `_unpack_fields`."""
    shifts = np.array([bits[1] + bits[2], bits[2], 0], dtype=np.uint32)
    fields: Words32 = np.bitwise_or.reduce(values.astype(np.uint32) << shifts, axis=1)
    return fields


def _lerp(ends: Doubles, share: Doubles) -> Doubles:
    """[N, 3] linear interpolation at `share` [N, 3] between `ends` [N, 2, 3]."""
    return ends[:, 0] * (1 - share) + ends[:, 1] * share


def _inverse_lerp(ends: Doubles, values: Doubles) -> Doubles:
    """[N, 3] positions of values between `ends` [N, 2, 3], in [0, 1]; inverse of `_lerp`."""
    extent = ends[:, 1] - ends[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(extent < _MIN_RANGE, 0.0, (values - ends[:, 0]) / extent)
    return share.clip(0, 1)
