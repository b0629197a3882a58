"""The container of SOG: a ZIP of meta.json and lossless WebP images. Input is untrusted."""

from __future__ import annotations

import io
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable, Mapping

import msgspec
import numpy as np
from PIL import Image

from keyss.core.arrays import Bytes
from keyss.core.errors import InputError
from keyss.files.formats.common import reason

_MAX_META_BYTES = 1 << 20
_MAX_MEMBERS = 64
_SMALL_IMAGE = 1 << 16  # pixels; larger images may have at most four times the pixels needed
_DATE = (1980, 1, 1, 0, 0, 0)  # constant, so that equal models make equal files

# Raised by zipfile for damaged archives and unknown compression.
_BROKEN = (
    *(zipfile.BadZipFile, zlib.error, struct.error, EOFError, OSError),
    *(ValueError, NotImplementedError, RuntimeError, OverflowError),
)


class Images(msgspec.Struct):
    """Names of image files."""

    files: list[str]


class Book(msgspec.Struct):
    """Images of indices into a codebook."""

    codebook: list[float]
    files: list[str]


class Means(msgspec.Struct):
    """Positions: bounds [3], and images of the low and high bytes."""

    mins: list[float]
    maxs: list[float]
    files: list[str]


class Harmonics(msgspec.Struct):
    """A palette of `count` vectors, and each Gaussian's index into it."""

    count: int
    bands: int
    codebook: list[float]
    files: list[str]


class Meta(msgspec.Struct, omit_defaults=True):
    """The meta.json of version 2."""

    version: int
    count: int
    means: Means
    scales: Book
    quats: Images
    sh0: Book
    shN: Harmonics | None = None


class _Version(msgspec.Struct):
    version: int = 1  # if missing


def read_meta(data: bytes) -> Meta:
    """A meta.json with all file names and bounds. Raises InputError."""
    if len(data) > _MAX_META_BYTES:
        raise InputError(f"expected a meta.json of at most {_MAX_META_BYTES:,} bytes, found {len(data):,}")
    try:
        version = msgspec.json.decode(data, type=_Version).version
        if version != 2:
            raise InputError(f"expected SOG of version 2, found {version}")
        meta = msgspec.json.decode(data, type=Meta)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f"cannot parse the meta.json of a SOG: {reason(error)}") from error
    needed = [(meta.means.files, 2), (meta.scales.files, 1), (meta.quats.files, 1), (meta.sh0.files, 1)]
    needed += [(meta.shN.files, 2)] if meta.shN else []
    if any(len(files) < count for files, count in needed):
        raise InputError("the meta.json of a SOG names fewer images than it needs")
    if not len(meta.means.mins) == len(meta.means.maxs) == 3:
        raise InputError("the meta.json of a SOG has no bounds of three coordinates")
    return meta


def open_archive(data: bytes) -> Callable[[str], bytes]:
    """A function that reads a file in the archive by name. Both raise InputError.

    All files together may unpack to twice the size of the archive plus 1 MiB.
    """
    try:
        archive = zipfile.ZipFile(io.BytesIO(data))
    except _BROKEN as error:
        raise InputError(f"not a whole SOG: {reason(error)}") from error
    members = archive.infolist()
    if len(members) > _MAX_MEMBERS:
        raise InputError(f"expected a SOG of at most {_MAX_MEMBERS} files, found {len(members):,}")
    if len({info.header_offset for info in members}) < len(members):
        raise InputError("damaged SOG: two of its files are at the same place")
    unpacked = sum(info.file_size for info in members)
    if unpacked > 2 * len(data) + _MAX_META_BYTES:
        raise InputError(f"damaged SOG: {len(data):,} bytes that unpack to {unpacked:,}")

    def read(name: str) -> bytes:
        try:
            info = archive.getinfo(name)
            if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise InputError(f"damaged SOG: {name[:80]!r} has an unsupported ZIP compression")
            with archive.open(info) as file:
                return file.read(info.file_size)
        except KeyError as error:
            raise InputError(
                f"not a SOG: there is no {name[:80]!r} in the archive; unpack it if it is another"
            ) from error
        except _BROKEN as error:
            raise InputError(f"damaged SOG: {name[:80]!r}: {reason(error)}") from error

    return read


def pack_archive(files: Mapping[str, bytes]) -> bytes:
    """An archive of files, stored, since they are compressed already."""
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_STORED) as archive:
        for name, content in files.items():
            archive.writestr(zipfile.ZipInfo(name, _DATE), content)
    return data.getvalue()


def decode_webp(data: bytes, count: int, width: int | None = None) -> Bytes:
    """[count, 4] RGBA of the first pixels of a lossless WebP, of this `width` if given.

    Checks the size before decoding. Raises InputError.
    """
    size = _webp_size(data)
    area = size[0] * size[1]
    if area < count or (width is not None and size[0] != width):
        raise InputError(f"damaged SOG: expected an image of {count:,} pixels, found {size[0]} x {size[1]}")
    if area > max(_SMALL_IMAGE, 4 * count):
        raise InputError(f"damaged SOG: an image of {size[0]} x {size[1]} for {count:,} pixels")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(data), formats=("WEBP",)) as image:
                if image.size != size:
                    raise InputError("damaged SOG: an image with two sizes")
                decoded = np.asarray(image.convert("RGBA")).reshape(-1, 4)
    except (OSError, ValueError, SyntaxError, EOFError, MemoryError, Image.DecompressionBombError) as error:
        raise InputError(f"damaged SOG: an image cannot be read: {reason(error)}") from error
    return decoded[:count]


def encode_webp(values: Bytes, width: int, height: int) -> bytes:
    """[M, 4] RGBA as the first pixels of a lossless WebP that keeps colours where alpha is 0."""
    canvas = np.zeros((height * width, 4), np.uint8)
    canvas[: len(values)] = values
    data = io.BytesIO()
    image = Image.fromarray(canvas.reshape(height, width, 4), "RGBA")
    image.save(data, "WEBP", lossless=True, exact=True, quality=50, method=1)
    return data.getvalue()


def _webp_size(data: bytes) -> tuple[int, int]:
    """(width, height) from the header of a lossless WebP; Pillow allocates a canvas when it opens a file.

    https://developers.google.com/speed/webp/docs/riff_container
    """
    if len(data) < 30 or data[:4] != b"RIFF" or data[8:12] != b"WEBP":
        raise InputError("damaged SOG: an image is not WebP")
    if data[12:16] == b"VP8L":
        (bits,) = struct.unpack_from("<I", data, 21)
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    if data[12:16] == b"VP8X" and b"VP8L" in data[30:]:
        return int.from_bytes(data[24:27], "little") + 1, int.from_bytes(data[27:30], "little") + 1
    raise InputError("damaged SOG: expected lossless WebP images, found others")
