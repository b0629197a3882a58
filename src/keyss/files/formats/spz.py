"""SPZ, Niantic's compressed format: reads versions 2, 3 and 4, writes models in version 3.

https://github.com/nianticlabs/spz. A header and six byte sections, compressed by gzip or, in version 4, zstd.
SPZ has y up and z towards the viewer (RUB), a .ply y down and z forward (RDF): like Niantic's library,
`quantise` and `dequantise` rotate models by 180 degrees about x.
"""

from __future__ import annotations

import math
import struct
import warnings
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import product
from typing import NamedTuple, Self

import numpy as np
import numpy.typing as npt
import zstandard

from keyss.core.arrays import Bytes, Floats, Shorts
from keyss.core.errors import InputError, KeyssWarning, OutputError, damaged, not_whole
from keyss.core.gaussians import Gaussians
from keyss.files.formats.common import (
    MIN_BYTES,
    Codes,
    arrays_of,
    check_count,
    check_sh_degree,
    from_smallest_three,
    gaussians_of,
    reason,
    round_half_away,
    smallest_three,
    to_bytes,
)

GZIP, NGSP = b"\x1f\x8b", b"NGSP"
_GZIP_HEADER = b"\x1f\x8b\x08\0\0\0\0\0\0\x03"  # zlib's, without time and name
_GZIP_BYTES, _PART = len(_GZIP_HEADER), 1 << 18
# zlib's level and memory, and the bytes that are compressed on their own; Niantic's library, gsply, others.
_SETTINGS = ((6, 9, 1 << 32), (6, 8, 1 << 18), *product((6, 9, *range(1, 6), 7, 8), (9, 8), (1 << 32,)))
EXTENSIONS = 2  # flag
_MAX_EXTENSION_BYTES = 1 << 20
MAX_FRACTIONAL_BITS = 24
_START = struct.Struct("<4sIIBBBB")  # see `_Header`
_PLACE = struct.Struct("<I12s")  # after it in version 4: offset of the table, reserved
_ENTRY = struct.Struct("<QQ")  # compressed and uncompressed bytes of a stream
_ZSTD_LEVEL = 12  # Niantic's library
_ZSTD_WINDOW = 1 << 23  # bytes that decoders should support (RFC 8878)
VERSION = 3  # written; has 10-bit rotations, and more programs read it than version 4
_FRACTIONAL_BITS = 12  # steps of 1/4096 world unit, as in Niantic's library; small scenes get more
_MIN_STEPS, _STEPS_PER_GAUSSIAN = 1024, 8  # across half the model, and across a Gaussian of median size
MAX_POSITION = 2**23 - 1  # largest position code
_LOG_SCALES = -10.0, 255 / 16 - 10
_MAX_CLIPPED = 0.01  # share of Gaussians with clipped scales above which there is a warning
_TYPICAL_LOG_SCALE = -4.0
_COLOR_SCALE = 0.15  # colours are 0.15 f_dc + 0.5
_MAGNITUDE = 2**9 - 1  # rotation components have a sign and 9 bits
_ROTATION_SHIFTS = np.array([20, 10, 0], np.uint32)
_SH_STEPS = np.array([8] * 3 + [16] * 12)  # 5 bits for degree 1, 4 bits above, as in Niantic's library

# Signs of the harmonics of degrees 1 to 3 under (x, y, z) -> (x, -y, -z).
_SH_SIGNS = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], dtype=np.float32)
_MEAN_SIGNS = np.array([1, -1, -1], dtype=np.float32)
_QUAT_SIGNS = np.array([1, 1, -1, -1], dtype=np.float32)  # wxyz


class _Header(NamedTuple):
    """The start of a file, the same in all versions."""

    magic: bytes
    version: int
    gaussians: int  # number
    sh_degree: int
    fractional_bits: int
    flags: int
    streams: int  # 0 before version 4

    @property
    def sizes(self) -> list[int]:
        """Bytes in each section: positions, alphas, colours, scales, rotations, harmonics."""
        rotation = 3 if self.version == 2 else 4
        return [self.gaussians * size for size in (9, 1, 3, 3, rotation, 3 * check_sh_degree(self.sh_degree))]

    @staticmethod
    def parse(start: bytes, size: int) -> _Header:
        """The header of a file of `size` bytes. Raises InputError."""
        if len(start) < _START.size or not start.startswith(NGSP):
            raise not_whole("SPZ file", "it ends inside the header, or does not begin with NGSP")
        header = _Header._make(_START.unpack_from(start))
        check_count(header.gaussians, size, MIN_BYTES + check_sh_degree(header.sh_degree) / 4)
        if header.fractional_bits > MAX_FRACTIONAL_BITS:
            raise InputError(
                f"expected positions of at most {MAX_FRACTIONAL_BITS} fractional bits, "
                f"found {header.fractional_bits}"
            )
        return header


def _gzip(content: bytes, like: bytes) -> bytes:
    """`content` in gzip, with the header and settings of the file `like`, else those of Niantic's library.

    Recompressing a file reveals its settings; other settings would show that it was rewritten.
    """
    header, settings = _GZIP_HEADER, _SETTINGS[0]
    if like.startswith(GZIP) and not like[3]:  # no optional header fields
        body = zlib.decompress(like, 31)
        header = like[:_GZIP_BYTES]
        settings = next((setting for setting in _SETTINGS if _is_packed_with(like, body, setting)), settings)
    end = struct.pack("<II", zlib.crc32(content), len(content) & 0xFFFFFFFF)
    return header + b"".join(_deflated(content, *settings)) + end


def _deflated(content: bytes, level: int, memory: int, block: int) -> Iterator[bytes]:
    """Deflate `content` in independent blocks of `block` bytes, and yield the output in parts."""
    for start in range(0, len(content), block):
        rows = memoryview(content)[start : start + block]
        packer = zlib.compressobj(level, zlib.DEFLATED, -zlib.MAX_WBITS, memory)
        for at in range(0, len(rows), _PART):
            yield packer.compress(rows[at : at + _PART])
        yield packer.flush(zlib.Z_FINISH if start + block >= len(content) else zlib.Z_SYNC_FLUSH)


def _is_packed_with(packed: bytes, content: bytes, settings: tuple[int, int, int]) -> bool:
    at = _GZIP_BYTES
    for part in _deflated(content, *settings):  # wrong settings fail in the first parts
        if not packed.startswith(part, at):
            return False
        at += len(part)
    return True


def _unpack_gzip(data: bytes) -> tuple[_Header, bytes, bytes]:
    """Header, sections and extensions of versions 2 and 3. Raises InputError."""
    stream = zlib.decompressobj(31)
    try:
        header = _Header.parse(stream.decompress(data, _START.size), len(data))
        if header.version not in (2, 3):
            raise InputError(f"expected version 2 or 3 of SPZ in gzip data, found version {header.version}")
        size = sum(header.sizes)
        body = stream.decompress(stream.unconsumed_tail, size + _MAX_EXTENSION_BYTES)
        if not stream.eof:  # zlib checks the trailing checksum in a further call
            body += stream.decompress(stream.unconsumed_tail, 1)
    except zlib.error as error:
        raise damaged("SPZ", f"{reason(error)}") from error
    if len(body) < size or not stream.eof:
        amount = "fewer" if len(body) < size or not stream.unconsumed_tail else "more"
        raise not_whole("SPZ", f"expected {size:,} bytes of {header.gaussians:,} Gaussians, found {amount}")
    return header, body[:size], body[size:] if header.flags & EXTENSIONS else b""


def _unpack_zstd(data: bytes) -> tuple[_Header, bytes, bytes]:
    """Header, sections and extensions of version 4. Raises InputError."""
    header = _Header.parse(data, len(data))
    if header.version != 4:
        raise InputError(f"expected version 4 of SPZ after NGSP, found version {header.version}")
    sizes = [size for size in header.sizes if size]
    if header.streams != len(sizes):
        raise damaged("SPZ", f"expected {len(sizes)} streams, found {header.streams}")
    at = int.from_bytes(data[_START.size : _START.size + 4], "little")
    start = at + len(sizes) * _ENTRY.size
    if at < _START.size + _PLACE.size or start > len(data):
        raise not_whole("SPZ", "its table lies outside of it")
    sections = []
    for size, (packed, unpacked) in zip(sizes, _ENTRY.iter_unpack(data[at:start]), strict=True):
        if unpacked != size or start + packed > len(data):
            raise not_whole("SPZ", "its table and its streams do not agree")
        sections.append(_zstd(data[start : start + packed], size))
        start += packed
    return header, b"".join(sections), data[_START.size + _PLACE.size : at]


def _zstd(packed: bytes, size: int) -> bytes:
    """The first `size` bytes of a stream. Raises InputError if it is shorter."""
    unpacker = zstandard.ZstdDecompressor(max_window_size=max(_ZSTD_WINDOW, 2 * size))
    try:
        with unpacker.stream_reader(packed) as reader:
            body = reader.read(size)
    except zstandard.ZstdError as error:
        raise damaged("SPZ", f"{reason(error)}") from error
    if len(body) != size:
        raise not_whole("SPZ", f"expected a stream of {size:,} bytes, found {len(body):,}")
    return body


@dataclass(frozen=True, eq=False)
class SpzCodes(Codes):
    """All integers of a file."""

    name = "spz"
    sorts = False

    version: int  # 2, 3 or 4
    fractional_bits: int  # 0 to 24: positions are multiples of 2^-fractional_bits world units
    flags: int  # 1: trained antialiased; 2: has `extensions`
    positions: npt.NDArray[np.int32]  # [N, 3] -2^23 to 2^23 - 1
    alphas: Bytes  # [N] opacities in 255ths
    colors: Bytes  # [N, 3] f_dc in steps of 1/38.25; 127.5 is 0
    scales: Bytes  # [N, 3] log scales in 16ths from -10 on
    largest: Bytes  # [N] index of the component of xyzw left out; always 3 in version 2
    # [N, 3] stored components: 512 (if negative) + magnitude in 511ths of sqrt(1/2); version 2: 8 bits
    rotations: Shorts
    sh: Bytes  # [N, K - 1, 3] harmonics in 128ths from -1 on
    extensions: bytes = b""  # not parsed
    packed: bytes = field(default=b"", repr=False)  # the original file

    @classmethod
    def parse(cls, data: bytes) -> Self:
        header, body, extensions = _unpack_gzip(data) if data.startswith(GZIP) else _unpack_zstd(data)
        n = header.gaussians
        sections = np.split(np.frombuffer(body, np.uint8), np.cumsum(header.sizes)[:-1])
        triples = sections[0].reshape(n, 3, 3).astype(np.int32)
        positions = triples[..., 0] | triples[..., 1] << 8 | triples[..., 2] << 16
        positions -= (positions & 0x800000) << 1
        if header.version == 2:
            largest, rotations = np.full(n, 3, np.uint8), sections[4].reshape(n, 3).astype(np.uint16)
        else:
            packed = sections[4].reshape(n, 4).view("<u4")[:, 0]
            largest = (packed >> 30).astype(np.uint8)
            rotations = (packed[:, None] >> _ROTATION_SHIFTS & np.uint32(1023)).astype(np.uint16)
        return cls(
            version=header.version,
            fractional_bits=header.fractional_bits,
            flags=header.flags,
            positions=positions,
            alphas=sections[1],
            colors=sections[2].reshape(n, 3),
            scales=sections[3].reshape(n, 3),
            largest=largest,
            rotations=rotations,
            sh=sections[5].reshape(n, -1, 3),
            extensions=extensions,
            packed=data,
        )

    def serialise(self) -> bytes:
        """See `Codes`. Keeps the version."""
        n = len(self)
        fixed = self.positions.astype("<i4").view(np.uint8).reshape(n, 3, 4)[..., :3]
        if self.version == 2:
            rotations = self.rotations.astype(np.uint8)
        else:
            parts = np.bitwise_or.reduce(self.rotations.astype(np.uint32) << _ROTATION_SHIFTS, axis=1)
            rotations = (self.largest.astype(np.uint32) << 30 | parts).astype("<u4")
        sections = [fixed, self.alphas, self.colors, self.scales, rotations, self.sh]
        contents = [section.tobytes() for section in sections if section.size]
        degree, streams = math.isqrt(self.sh.shape[1]), len(contents) if self.version == 4 else 0
        header = _Header(NGSP, self.version, n, degree, self.fractional_bits, self.flags, streams)
        start = _START.pack(*header)
        if self.version < 4:
            return _gzip(b"".join([start, *contents, self.extensions]), self.packed)
        compressor = zstandard.ZstdCompressor(level=_ZSTD_LEVEL)
        packed = [compressor.compress(section) for section in contents]
        table = [_ENTRY.pack(len(stream), len(whole)) for stream, whole in zip(packed, contents, strict=True)]
        place = _PLACE.pack(_START.size + _PLACE.size + len(self.extensions), bytes(12))
        return b"".join([start, place, self.extensions, *table, *packed])

    @classmethod
    def quantise(cls, model: Gaussians, fractional_bits: int | None = None) -> Self:
        """See `Codes`. Writes version 3. Raises OutputError for positions beyond 8 million.

        Warns (KeyssWarning) of clipped scales.
        """
        means, quats, log_scales, opacities, f_dc, rest = arrays_of(model)
        bits = _fractional_bits(means, log_scales) if fractional_bits is None else fractional_bits
        _warn_of_clipped_scales(log_scales)
        largest, xyz = smallest_three(np.roll(quats * _QUAT_SIGNS, -1, axis=1))
        magnitudes = np.floor(np.abs(xyz) * (_MAGNITUDE / np.sqrt(0.5)) + 0.5).clip(0, _MAGNITUDE)
        return cls(
            version=VERSION,
            fractional_bits=bits,
            flags=0,
            positions=round_half_away(np.ldexp(means.astype(float), bits) * _MEAN_SIGNS).astype(np.int32),
            alphas=to_bytes(opacities * 255),
            colors=to_bytes(f_dc.astype(np.float64) * (_COLOR_SCALE * 255) + 127.5),
            scales=to_bytes((log_scales.astype(np.float64) + 10) * 16),
            largest=largest,
            rotations=magnitudes.astype(np.uint16) | np.where(xyz < 0, 512, 0).astype(np.uint16),
            sh=_quantised_harmonics(rest),
        )

    def decode_part(self, part: slice) -> Gaussians:
        means = np.ldexp(self.positions[part].astype(np.float64), -self.fractional_bits) * _MEAN_SIGNS
        rotations = self.rotations[part]
        if self.version == 2:
            xyz = rotations / 127.5 - 1
        else:
            xyz = np.where(rotations & 512, -1.0, 1.0) * (rotations & _MAGNITUDE)
            xyz *= np.sqrt(0.5) / _MAGNITUDE
        quats = np.roll(from_smallest_three(self.largest[part], xyz), 1, axis=1) * _QUAT_SIGNS
        return gaussians_of(
            means,
            quats,
            self.scales[part] / 16 - 10,
            self.alphas[part] / 255,
            (self.colors[part] / 255 - 0.5) / _COLOR_SCALE,
            (self.sh[part].astype(np.float32) - 128) * (_SH_SIGNS[: self.sh.shape[1], None] / 128),
        )


def _fractional_bits(means: Floats, log_scales: Floats) -> int:
    """12, more for models in small units, or fewer for distant positions."""
    extent = float(np.abs(means).max())
    spread = float(np.median(np.abs(means - np.median(means, axis=0)).max(axis=1)))
    size = math.exp(float(np.median(log_scales.max(axis=1)).clip(-60, 60)))
    wanted = math.ceil(math.log2(max(_MIN_STEPS / max(spread, 1e-20), _STEPS_PER_GAUSSIAN / size)))
    if not extent < MAX_POSITION:
        raise OutputError(
            f"SPZ holds positions up to {MAX_POSITION:,} world units, and this model reaches {extent:.3g}: "
            "write another format, or move the model or remove Gaussians far out first"
        )
    most = min(max(wanted, _FRACTIONAL_BITS), MAX_FRACTIONAL_BITS)
    return next(bits for bits in range(most, -1, -1) if extent * 2**bits < MAX_POSITION)


def _warn_of_clipped_scales(log_scales: Floats) -> None:
    """Warn if more than _MAX_CLIPPED of the Gaussians have two axes out of range."""
    size = np.sort(log_scales, axis=1)[:, 1]
    if (share := float(((size < _LOG_SCALES[0]) | (size > _LOG_SCALES[1])).mean())) > _MAX_CLIPPED:
        least, most = np.exp(_LOG_SCALES)
        factor = np.exp(_TYPICAL_LOG_SCALE - np.median(size))
        warnings.warn(
            f"{share:.0%} of the Gaussians are smaller than {least:.2g} or larger than {most:.3g} world "
            "units, between which .spz holds scales, and change: write another format, or scale the model "
            f"first, e.g. with `splat-transform IN -s {factor:.2g} OUT.ply`",
            KeyssWarning,
            stacklevel=2,
        )


def _quantised_harmonics(rest: Floats) -> Bytes:
    """[N, K - 1, 3] codes that are multiples of `_SH_STEPS`, which compresses better."""
    levels = np.empty(rest.shape, np.uint8)
    for at in range(rest.shape[1]):  # one by one saves memory
        step = _SH_STEPS[at]
        codes = round_half_away(rest[:, at].astype(np.float64) * _SH_SIGNS[at] * 128) + 128
        levels[:, at] = (np.floor((codes + step // 2) / step) * step).clip(0, 255)
    return levels
