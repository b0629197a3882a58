"""The .ksplat of mkkellogg's viewer: sections of buckets, in floats, half floats or integers. Read only.

https://github.com/mkkellogg/GaussianSplats3D, SplatBuffer. No library of Python that is kept up reads it
from bytes that nobody vouches for, and the viewer that it belongs to is no longer developed.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from keyss.core.errors import InputError
from keyss.core.gaussians import Gaussians
from keyss.files.formats.common import (
    Doubles,
    check_count,
    f_dc_of,
    gaussians_of,
    log_scales_of,
    logits,
    unit,
)

_HEADER_BYTES, _SECTION_BYTES = 4096, 1024
_HEADER = struct.Struct("<BBxxIIIIH14xff")  # version, sections, full ones, Gaussians twice, level, SH range
_SECTION = struct.Struct("<IIIIfHxxIIIIH")
_SH_RANGE = 1.5  # where a file gives none
_FINEST = 32767  # half the range of a position's code, likewise
_COEFFICIENTS = (0, 9, 24, 45)  # of harmonics of degree 0 to 3; the viewer goes to 2, other writers to 3
_TYPES = (("<f4", "<f4", "<f4"), ("<u2", "<f2", "<f2"), ("<u2", "<f2", "u1"))  # positions, scales, harmonics


@dataclass(frozen=True)
class _Section:
    """One section's header."""

    count: int  # Gaussians
    room: int  # Gaussians that it has room for
    bucket: int  # Gaussians of a full bucket
    buckets: int
    block: float  # side of a bucket in world units
    bucket_bytes: int
    finest: int  # half the range of a position's code; 0: the usual one
    size: int  # bytes
    full: int  # buckets
    partial: int  # buckets
    degree: int


def read_ksplat(data: bytes) -> Gaussians:
    """The model in a file, of the largest degree of its sections. Raises InputError."""
    if len(data) < _HEADER_BYTES:
        raise InputError("not a whole .ksplat: it ends inside the header")
    major, minor, room, _, _, count, level, low, high = _HEADER.unpack_from(data)
    if major != 0 or minor < 1 or level >= len(_TYPES):
        raise InputError(
            f"expected a .ksplat of version 0.1 and level 0 to 2, found {major}.{minor} and {level}"
        )
    check_count(count, len(data))
    at = _HEADER_BYTES + room * _SECTION_BYTES
    if at > len(data):
        raise InputError(f"not a whole .ksplat: it announces {room:,} sections")
    limits = (low or -_SH_RANGE, high or _SH_RANGE)
    parts = []
    for index in range(room):
        section = _Section(*_SECTION.unpack_from(data, _HEADER_BYTES + index * _SECTION_BYTES))
        part, at = _read(data, at, section, level, limits)
        parts += [part] if part is not None else []
    if sum(len(part) for part in parts) != count:
        raise InputError(f"damaged .ksplat: its sections do not have {count:,} Gaussians")
    degree = max(part.sh_degree for part in parts)
    return Gaussians.cat([part.with_sh_degree(degree) for part in parts])


def _read(
    data: bytes, at: int, section: _Section, level: int, limits: tuple[float, float]
) -> tuple[Gaussians | None, int]:
    """The Gaussians of a section whose bytes begin at `at`, if it has any, and where the next one's do."""
    if section.degree >= len(_COEFFICIENTS):
        raise InputError(f"expected harmonics of degree 0 to 3 in a .ksplat, found {section.degree}")
    position, number, harmonic = _TYPES[level]
    row = np.dtype(
        [
            *(("mean", position, 3), ("scale", number, 3), ("quat", number, 4), ("rgba", "u1", 4)),
            ("sh", harmonic, _COEFFICIENTS[section.degree]),
        ]
    )
    sizes = 4 * section.partial
    centres = at + sizes
    rows_at = centres + section.bucket_bytes * section.buckets
    end = rows_at + section.room * row.itemsize
    if end > len(data) or section.count > section.room or (level and section.bucket_bytes != 12):
        raise InputError("not a whole .ksplat: a section lies outside of it")
    if section.count == 0:
        return None, end
    rows = np.frombuffer(data, row, section.count, rows_at)
    means = rows["mean"].astype(np.float64)
    if level:
        partial = np.frombuffer(data, "<u4", section.partial, at)
        middles = np.frombuffer(data, "<f4", 3 * section.buckets, centres).reshape(-1, 3)
        finest = section.finest or _FINEST
        means = (means - finest) * (section.block / 2 / finest) + middles[_buckets(section, partial)]
    harmonics = rows["sh"].astype(np.float64)
    if level == 2:
        harmonics = limits[0] + harmonics / 255 * (limits[1] - limits[0])
    model = gaussians_of(
        means,
        unit(rows["quat"]),
        log_scales_of(rows["scale"]),
        logits(rows["rgba"][:, 3] / 255),
        f_dc_of(rows["rgba"][:, :3] / 255),
        _in_order(harmonics),
    )
    return model, end


def _buckets(section: _Section, partial: npt.NDArray[np.uint32]) -> npt.NDArray[np.int64]:
    """[N] which bucket each Gaussian of a section lies in: the full ones come first."""
    index = np.arange(section.count, dtype=np.int64)
    in_full = section.full * section.bucket
    ends = in_full + np.cumsum(partial.astype(np.int64))
    found: npt.NDArray[np.int64] = np.where(
        index < in_full,
        index // max(section.bucket, 1),
        section.full + np.searchsorted(ends, index, side="right"),
    )
    if len(found) and found.max() >= section.buckets:
        raise InputError("damaged .ksplat: Gaussians without a bucket")
    return found


def _in_order(harmonics: Doubles) -> Doubles:
    """[N, K - 1, 3] of a row's [N, 3 (K - 1)]: degree by degree, each with all red ones first."""
    n, count = harmonics.shape
    bands = np.split(harmonics, [each for each in _COEFFICIENTS if 0 < each < count], axis=1)
    return np.concatenate([band.reshape(n, 3, -1).transpose(0, 2, 1) for band in bands], axis=1)
