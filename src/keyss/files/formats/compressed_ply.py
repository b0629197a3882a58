"""Compressed .ply, PlayCanvas's format: chunks of 256 Gaussians, and 16 bytes and harmonics for each.

https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/ply/#compressed-ply. Within a chunk,
positions, log scales and colours lie between a smallest and a largest value of each coordinate, so that they
are the finer the nearer a chunk's Gaussians are to each other: `write_compressed_ply` sorts them.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from keyss.core.errors import InputError
from keyss.core.gaussians import SH_C0, Gaussians
from keyss.files.formats.common import (
    Bytes,
    CodedGaussians,
    Codes,
    Doubles,
    Floats,
    Shorts,
    arrays_of,
    f_dc_of,
    from_smallest_three,
    gaussians_of,
    in_morton_order,
    logits,
    opacities,
    smallest_three,
    to_bytes,
    unit,
)
from keyss.files.ply_table import ply_header, read_tables

CHUNK = 256  # Gaussians
_VECTOR = (11, 10, 11)  # bits of x, y, z
_SCALE_LIMIT = 20.0  # log scales are cut to +- this
_SMALLEST_RANGE = 1e-5  # below it, all of a chunk's values are its smallest

_BOUNDS = [
    f"{end}_{name}"
    for names in ("x y z", "scale_x scale_y scale_z", "r g b")
    for end in ("min", "max")
    for name in names.split()
]
_PACKED = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]


@dataclass(frozen=True, eq=False)
class CompressedPlyCodes(Codes):
    """All numbers of a file; Gaussian i lies in chunk i // 256. See `dequantise` for their meaning."""

    bounds: Floats  # [C, 18] smallest, then largest x y z; log scales; r g b (0 to 1: of f_dc * SH_C0 + 0.5)
    positions: Shorts  # [N, 3] 11, 10 and 11 bits, between the bounds
    largest: Bytes  # [N] which of w, x, y, z (0 to 3) is not stored
    rotations: Shorts  # [N, 3] 10 bits each, the others from -sqrt(1/2) to sqrt(1/2)
    scales: Shorts  # [N, 3] 11, 10 and 11 bits, between the bounds
    colors: Bytes  # [N, 3] between the bounds
    alphas: Bytes  # [N] opacities in 255ths
    sh: Bytes  # [N, K - 1, 3] harmonics in 32nds from -4 on

    def __len__(self) -> int:
        return len(self.positions)


def parse(data: bytes) -> CompressedPlyCodes:
    """The codes of a file; colours without bounds, as old ones have, get 0 and 1.

    Raises InputError for anything that is not a whole compressed .ply.
    """
    tables = read_tables(io.BytesIO(data), Path("compressed .ply"))
    vertex, chunk = tables["vertex"], tables.get("chunk")
    n = len(vertex)
    if chunk is None or not _has(vertex, _PACKED, "u4") or not _has(chunk, _BOUNDS[:12], "f4"):
        raise InputError("not a compressed .ply: expected chunks of floats and vertices of packed integers")
    if n == 0:
        raise InputError("it holds no Gaussians")
    if len(chunk) != -(-n // CHUNK):
        raise InputError(f"expected {-(-n // CHUNK):,} chunks of {n:,} Gaussians, found {len(chunk):,}")
    bounds = np.tile(np.repeat(np.array([0, 1], np.float32), 3), (len(chunk), 3))
    for column, name in enumerate(_BOUNDS if _has(chunk, _BOUNDS, "f4") else _BOUNDS[:12]):
        bounds[:, column] = chunk[name]
    position, rotation, scale, color = (vertex[name].astype(np.uint32) for name in _PACKED)
    return CompressedPlyCodes(
        bounds=bounds,
        positions=_fields(position, _VECTOR).astype(np.uint16),
        largest=(rotation >> 30).astype(np.uint8),
        rotations=_fields(rotation, (10, 10, 10)).astype(np.uint16),
        scales=_fields(scale, _VECTOR).astype(np.uint16),
        colors=_fields(color >> 8, (8, 8, 8)).astype(np.uint8),
        alphas=(color & 255).astype(np.uint8),
        sh=_harmonics(tables.get("sh"), n),
    )


def serialise(codes: CompressedPlyCodes) -> bytes:
    """A file of the codes."""
    n, k = codes.sh.shape[:2]
    packed = np.empty((n, 4), dtype="<u4")
    packed[:, 0] = _joined(codes.positions, _VECTOR)
    packed[:, 1] = codes.largest.astype(np.uint32) << 30 | _joined(codes.rotations, (10, 10, 10))
    packed[:, 2] = _joined(codes.scales, _VECTOR)
    packed[:, 3] = _joined(codes.colors, (8, 8, 8)) << np.uint32(8) | codes.alphas
    elements = {
        "chunk": (len(codes.bounds), [f"float {name}" for name in _BOUNDS]),
        "vertex": (n, [f"uint {name}" for name in _PACKED]),
    }
    if k:
        elements["sh"] = (n, [f"uchar f_rest_{i}" for i in range(3 * k)])
    harmonics = codes.sh.transpose(0, 2, 1).tobytes()
    return ply_header(elements) + codes.bounds.astype("<f4").tobytes() + packed.tobytes() + harmonics


def dequantise(codes: CompressedPlyCodes) -> Gaussians:
    """The model that codes stand for. Raises InputError for bounds that are not finite."""
    bounds = codes.bounds.astype(np.float64).repeat(CHUNK, axis=0)[: len(codes)].reshape(-1, 3, 2, 3)
    most = 2.0 ** np.array(_VECTOR) - 1
    rotations = (codes.rotations / 1023 - 0.5) * np.sqrt(2)
    harmonics = np.where(codes.sh == 0, 0.0, np.where(codes.sh == 255, 256.0, codes.sh + 0.5))
    return gaussians_of(
        _between(bounds[:, 0], codes.positions / most),
        from_smallest_three(codes.largest, rotations),
        _between(bounds[:, 1], codes.scales / most),
        logits(codes.alphas / 255),
        f_dc_of(_between(bounds[:, 2], codes.colors / 255)),
        harmonics / 32 - 4,
    )


def quantise(model: Gaussians) -> CompressedPlyCodes:
    """The codes of a model in its order, each 256 of its Gaussians a chunk."""
    means, quats, log_scales, opacity_logits, f_dc, rest = arrays_of(model)
    colors = f_dc.astype(np.float64) * SH_C0 + 0.5
    parts = [means.astype(np.float64), log_scales.astype(np.float64), colors]
    bounds = np.concatenate([_bounds(each) for each in parts], axis=1)
    bounds[:, 6:12] = bounds[:, 6:12].clip(-_SCALE_LIMIT, _SCALE_LIMIT)
    bounds = bounds.astype(np.float32)
    ends = bounds.astype(np.float64).repeat(CHUNK, axis=0)[: len(model)].reshape(-1, 3, 2, 3)
    position, scale, color = (_share(ends[:, i], values) for i, values in enumerate(parts))
    largest, others = smallest_three(unit(quats))
    most = 2.0 ** np.array(_VECTOR) - 1
    return CompressedPlyCodes(
        bounds=bounds,
        positions=np.floor(position * most + 0.5).astype(np.uint16),
        largest=largest,
        rotations=to_bytes(np.floor((others * np.sqrt(0.5) + 0.5) * 1023 + 0.5), 1023),
        scales=np.floor(scale * most + 0.5).astype(np.uint16),
        colors=to_bytes(np.floor(color * 255 + 0.5)),
        alphas=to_bytes(np.floor(opacities(opacity_logits) * 255 + 0.5)),
        sh=to_bytes(np.trunc((rest.astype(np.float64) / 8 + 0.5) * 256)),
    )


def read_compressed_ply(data: bytes) -> CodedGaussians:
    """The model in a file. Raises InputError."""
    codes = parse(data)
    return CodedGaussians.of(dequantise(codes), codes)


def write_compressed_ply(model: Gaussians) -> bytes:
    """A model as a file, sorted so that the Gaussians of a chunk are near each other."""
    if isinstance(model, CodedGaussians) and isinstance(model.codes, CompressedPlyCodes):
        return serialise(model.codes)
    return serialise(quantise(in_morton_order(model)))


def _has(table: npt.NDArray[np.void], names: list[str], code: str) -> bool:
    found: Mapping[str, Any] = table.dtype.fields or {}
    return all(name in found and found[name][0].newbyteorder("=") == np.dtype(code) for name in names)


def _harmonics(table: npt.NDArray[np.void] | None, n: int) -> Bytes:
    """[N, K - 1, 3] codes of the element `sh`, which has all red ones first; none where it is missing."""
    if table is None:
        return np.empty((n, 0, 3), np.uint8)
    names = list(table.dtype.names or ())
    if names != [f"f_rest_{i}" for i in range(len(names))] or len(names) not in (9, 24, 45):
        raise InputError(f"expected 9, 24 or 45 properties f_rest_0, f_rest_1, ..., found {len(names)}")
    if len(table) != n or not _has(table, names, "u1"):
        raise InputError(f"expected harmonics of {n:,} Gaussians as bytes, found others")
    found: Bytes = np.ascontiguousarray(table).view(np.uint8).reshape(n, 3, -1).transpose(0, 2, 1).copy()
    return found


def _fields(packed: npt.NDArray[Any], bits: tuple[int, int, int]) -> npt.NDArray[np.uint32]:
    """[N, 3] the lowest bits of `packed` [N], the last of the three lowest."""
    shifts = np.array([bits[1] + bits[2], bits[2], 0], dtype=np.uint32)
    masks = np.array([2**each - 1 for each in bits], dtype=np.uint32)
    found: npt.NDArray[np.uint32] = packed[:, None] >> shifts & masks
    return found


def _joined(values: npt.NDArray[Any], bits: tuple[int, int, int]) -> npt.NDArray[np.uint32]:
    """[N] the inverse of `_fields`."""
    shifts = np.array([bits[1] + bits[2], bits[2], 0], dtype=np.uint32)
    found: npt.NDArray[np.uint32] = np.bitwise_or.reduce(values.astype(np.uint32) << shifts, axis=1)
    return found


def _between(ends: Doubles, share: Doubles) -> Doubles:
    """Values at `share` [N, 3] of the way between `ends` [N, 2, 3]."""
    return ends[:, 0] * (1 - share) + ends[:, 1] * share


def _bounds(values: Doubles) -> Doubles:
    """[C, 6] smallest and largest of each coordinate in each chunk of `values` [N, 3]."""
    starts = np.arange(0, len(values), CHUNK)
    both = [ufunc.reduceat(values, starts, axis=0) for ufunc in (np.minimum, np.maximum)]
    return np.concatenate(both, axis=1)


def _share(ends: Doubles, values: Doubles) -> Doubles:
    """[N, 3] where values lie between `ends` [N, 2, 3]: 0 to 1."""
    extent = ends[:, 1] - ends[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(extent < _SMALLEST_RANGE, 0.0, (values - ends[:, 0]) / extent)
    found: Doubles = share.clip(0, 1)
    return found
