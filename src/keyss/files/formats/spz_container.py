"""The container of an SPZ: a header and six byte sections, compressed by gzip or, in version 4, zstd."""

from __future__ import annotations

import gzip
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import zstandard

from keyss.core.arrays import Bytes
from keyss.core.errors import InputError
from keyss.files.formats.common import check_count, check_sh_degree, reason

GZIP, NGSP = b"\x1f\x8b", b"NGSP"
EXTENSIONS = 2  # flag: the file has extensions
_MAX_EXTENSION_BYTES = 1 << 20
_MAX_FRACTIONAL_BITS = 24
_LEGACY = struct.Struct("<4sIIBBBB")  # magic, version, count, SH degree, fractional bits, flags, reserved
_HEADER = struct.Struct("<4sIIBBBBI12s")  # ..., flags, number of streams, offset of the table, reserved
_ENTRY = struct.Struct("<QQ")  # of the table: compressed and uncompressed bytes
_ZSTD_LEVEL = 12  # as in Niantic's library
_ZSTD_WINDOW = 1 << 27


@dataclass(frozen=True)
class Header:
    """The header fields of all versions."""

    version: int
    count: int
    sh_degree: int
    fractional_bits: int
    flags: int
    extensions: bytes

    @property
    def sizes(self) -> list[int]:
        """Bytes of the sections: positions, alphas, colours, scales, rotations and harmonics."""
        rotation = 3 if self.version == 2 else 4
        return [self.count * each for each in (9, 1, 3, 3, rotation, 3 * check_sh_degree(self.sh_degree))]


def unpack(data: bytes) -> tuple[Header, list[Bytes]]:
    """The header and the six sections. Raises InputError; allocates no more than `data` can hold."""
    if data.startswith(GZIP):
        return _unpack_gzip(data)
    if data.startswith(NGSP):
        return _unpack_zstd(data)
    raise InputError("not an SPZ file: it begins neither as gzip data nor with NGSP")


def pack(header: Header, sections: Sequence[bytes]) -> bytes:
    """A file of the six sections."""
    common = (NGSP, header.version, header.count, header.sh_degree, header.fractional_bits, header.flags)
    if header.version < 4:
        return gzip.compress(_LEGACY.pack(*common, 0) + b"".join(sections) + header.extensions, 6, mtime=0)
    compressor = zstandard.ZstdCompressor(level=_ZSTD_LEVEL)
    streams = [(len(each), compressor.compress(each)) for each in sections if each]
    table = b"".join(_ENTRY.pack(len(packed), size) for size, packed in streams)
    at = _HEADER.size + len(header.extensions)
    start = _HEADER.pack(*common, len(streams), at, bytes(12)) + header.extensions
    return start + table + b"".join(packed for _, packed in streams)


def _unpack_gzip(data: bytes) -> tuple[Header, list[Bytes]]:
    stream = zlib.decompressobj(31)
    try:
        start = stream.decompress(data, _LEGACY.size)
        if len(start) < _LEGACY.size or not start.startswith(NGSP):
            raise InputError("not an SPZ file: the gzip data do not hold one")
        _, version, count, degree, bits, flags, _ = _LEGACY.unpack(start)
        if version == 1:
            raise InputError("SPZ of version 1, which was never published; expected 2, 3 or 4")
        if version not in (2, 3):
            raise InputError(f"expected SPZ of version 2 or 3 in gzip data, found {version}")
        header = _checked(Header(version, count, degree, bits, flags, b""), len(data))
        limit = sum(header.sizes) + _MAX_EXTENSION_BYTES
        body = stream.decompress(stream.unconsumed_tail, limit)
        if not stream.eof:  # zlib checks the trailing checksum in a further call
            body += stream.decompress(stream.unconsumed_tail, 1)
    except zlib.error as error:
        raise InputError(f"damaged SPZ: {reason(error)}") from error
    size = sum(header.sizes)
    if len(body) < size or not stream.eof:
        found = "cut short" if len(body) < size or not stream.unconsumed_tail else "more than was announced"
        raise InputError(f"not a whole SPZ: expected {size:,} bytes of {count:,} Gaussians, found {found}")
    ends = np.cumsum([0, *header.sizes])
    values = np.frombuffer(body, np.uint8, size)
    sections = [values[start:end] for start, end in pairwise(ends)]
    return Header(version, count, degree, bits, flags, body[size:] if flags & EXTENSIONS else b""), sections


def _unpack_zstd(data: bytes) -> tuple[Header, list[Bytes]]:
    if len(data) < _HEADER.size:
        raise InputError("not a whole SPZ: it ends inside the header")
    _, version, count, degree, bits, flags, streams, at, _ = _HEADER.unpack_from(data)
    if version != 4:
        raise InputError(f"expected SPZ of version 4 after NGSP, found {version}")
    header = _checked(Header(version, count, degree, bits, flags, data[_HEADER.size : at]), len(data))
    sizes = header.sizes
    if streams != sum(size > 0 for size in sizes):
        raise InputError(f"damaged SPZ: expected {sum(size > 0 for size in sizes)} streams, found {streams}")
    start = at + streams * _ENTRY.size
    if at < _HEADER.size or start > len(data):
        raise InputError("not a whole SPZ: its table lies outside of it")
    table = iter(_ENTRY.iter_unpack(data[at:start]))
    sections = []
    for size in sizes:
        packed, unpacked = next(table) if size else (0, 0)
        if unpacked != size or start + packed > len(data):
            raise InputError("not a whole SPZ: its table and its streams do not agree")
        sections.append(_zstd(data[start : start + packed], size) if size else np.empty(0, np.uint8))
        start += packed
    return header, sections


def _zstd(packed: bytes, size: int) -> Bytes:
    """[size] the first bytes of a stream. Raises InputError if there are fewer."""
    try:
        with zstandard.ZstdDecompressor(max_window_size=_ZSTD_WINDOW).stream_reader(packed) as reader:
            body = reader.read(size)
    except zstandard.ZstdError as error:
        raise InputError(f"damaged SPZ: {reason(error)}") from error
    if len(body) != size:
        raise InputError(f"not a whole SPZ: expected a stream of {size:,} bytes, found {len(body):,}")
    return np.frombuffer(body, np.uint8)


def _checked(header: Header, size: int) -> Header:
    check_sh_degree(header.sh_degree)
    check_count(header.count, size)
    if header.fractional_bits > _MAX_FRACTIONAL_BITS:
        raise InputError(
            f"expected positions of at most {_MAX_FRACTIONAL_BITS} fractional bits, "
            f"found {header.fractional_bits}"
        )
    return header
