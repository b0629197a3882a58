"""SOG, PlayCanvas's format: a ZIP of meta.json and lossless WebP images; reads and writes version 2.

Reads them beside each other too, as programs leave them for web servers.

https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog/
"""

from __future__ import annotations

import io
import math
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import msgspec
import numpy as np
from PIL import Image

from keyss.core.arrays import Bytes, Doubles, Floats, Numbers, Shorts
from keyss.core.errors import InputError, damaged, not_whole
from keyss.core.gaussians import Gaussians
from keyss.files.formats.codebooks import SIZE, codebook_of, nearest, palette_of
from keyss.files.formats.common import (
    MIN_BYTES,
    Codes,
    arrays_of,
    check_count,
    check_sh_degree,
    from_smallest_three,
    gaussians_of,
    reason,
    smallest_three,
    to_bytes,
)
from keyss.files.inputs import MAX_BYTES, read_file

_MAX_POSITION = 65535  # largest position code
_LARGEST = 252  # a quaternion's fourth byte: this plus the index (wxyz) of the component left out
_ROW = 64  # palette vectors per row of pixels
_MAX_LABELS = 65536
_MAX_META_BYTES = 1 << 20
_MAX_MEMBERS = 64
_SMALL_IMAGE = 1 << 16  # pixels; larger images may have at most four times the pixels needed
_DATE = (1980, 1, 1, 0, 0, 0)  # constant, so that equal models make equal files

# Raised by zipfile for damaged archives and unknown compression.
_BROKEN = (
    *(zipfile.BadZipFile, zlib.error, struct.error, EOFError, OSError),
    *(ValueError, NotImplementedError, RuntimeError, OverflowError),
)


class _Part(msgspec.Struct, omit_defaults=True):
    """The images of an attribute, and what their numbers mean."""

    count: int = 0  # vectors in a palette
    bands: int = 0  # their SH degree
    mins: list[float] = []  # [3] bounds of positions, whose images have the low and the high bytes
    maxs: list[float] = []
    codebook: list[float] = []
    files: list[str] = []


class _Meta(msgspec.Struct, omit_defaults=True):
    """The meta.json of version 2."""

    version: int
    count: int
    means: _Part
    scales: _Part
    quats: _Part
    sh0: _Part
    shN: _Part | None = None


class _Version(msgspec.Struct):
    version: int = 1  # if missing


@dataclass(frozen=True, eq=False)
class SogCodes(Codes):
    """All values of a file."""

    name = "sog"

    mins: Doubles  # [3] bounds of positions, as sign(x) ln(|x| + 1)
    maxs: Doubles  # [3]
    positions: Shorts  # [N, 3] 65535ths between the bounds
    largest: Bytes  # [N] index of the component of wxyz left out
    rotations: Bytes  # [N, 3] components that are stored, from -sqrt(1/2) to sqrt(1/2)
    scale_codebook: Floats  # [256] log scales
    scales: Bytes  # [N, 3] codebook indices
    color_codebook: Floats  # [256] f_dc
    colors: Bytes  # [N, 3] codebook indices
    alphas: Bytes  # [N] opacities in 255ths
    sh_codebook: Floats  # [256] harmonics; [0] for degree 0
    palette: Bytes  # [P, K - 1, 3] codebook indices
    labels: Shorts  # [N] indices into the palette; 0 for degree 0

    @classmethod
    def parse(cls, data: bytes) -> Self:
        file = _open_archive(data)
        meta = _read_meta(file("meta.json"))
        n = meta.count
        check_count(n, len(data), MIN_BYTES + check_sh_degree(meta.shN.bands if meta.shN else 0) / 4)

        def image(names: list[str], index: int = 0) -> Bytes:
            """[N, 4] the first N pixels, RGBA."""
            return _decode_webp(file(names[index]), n)

        low, high = image(meta.means.files), image(meta.means.files, 1)
        quats, colors = image(meta.quats.files), image(meta.sh0.files)
        if (quats[:, 3] < _LARGEST).any():
            raise damaged("SOG", "expected 252 to 255 in the fourth channel of its quaternions")
        sh_codebook, palette, labels = _no_harmonics(n)
        if meta.shN is not None and meta.shN.bands:
            k = check_sh_degree(meta.shN.bands)
            sh_codebook = _codebook(meta.shN.codebook)
            pair = image(meta.shN.files, 1)
            labels = _uint16(pair[:, 0], pair[:, 1])
            if not int(labels.max()) < meta.shN.count <= _MAX_LABELS:
                raise damaged("SOG", "labels beyond the end of its palette")
            size = -(-meta.shN.count // _ROW) * _ROW
            rows = _decode_webp(file(meta.shN.files[0]), size * k, width=_ROW * k)
            palette = rows[: meta.shN.count * k, :3].reshape(-1, k, 3).copy()
        return cls(
            mins=np.array(meta.means.mins, np.float64),
            maxs=np.array(meta.means.maxs, np.float64),
            positions=_uint16(low[:, :3], high[:, :3]),
            largest=quats[:, 3] - np.uint8(_LARGEST),
            rotations=quats[:, :3].copy(),
            scale_codebook=_codebook(meta.scales.codebook),
            scales=image(meta.scales.files)[:, :3].copy(),
            color_codebook=_codebook(meta.sh0.codebook),
            colors=colors[:, :3].copy(),
            alphas=colors[:, 3].copy(),
            sh_codebook=sh_codebook,
            palette=palette,
            labels=labels,
        )

    def serialise(self) -> bytes:
        n, (p, k) = len(self), self.palette.shape[:2]
        images = {
            "means_l.webp": _rgba(self.positions & 255),
            "means_u.webp": _rgba(self.positions >> 8),
            "quats.webp": _rgba(self.rotations, self.largest + np.uint8(_LARGEST)),
            "scales.webp": _rgba(self.scales),
            "sh0.webp": _rgba(self.colors, self.alphas),
        }
        if k:
            labels = np.stack([self.labels & 255, self.labels >> 8, np.zeros_like(self.labels)], axis=1)
            images["shN_labels.webp"] = _rgba(labels)
        width = math.ceil(math.sqrt(n) / 4) * 4
        height = math.ceil(n / width / 4) * 4
        files = {name: _encode_webp(pixels, width, height) for name, pixels in images.items()}
        harmonics = None
        if k:
            palette = _rgba(self.palette.reshape(-1, 3))
            files["shN_centroids.webp"] = _encode_webp(palette, _ROW * k, -(-p // _ROW))
            names = ["shN_centroids.webp", "shN_labels.webp"]
            harmonics = _Part(p, math.isqrt(k), codebook=self.sh_codebook.tolist(), files=names)
        meta = _Meta(
            version=2,
            count=n,
            means=_Part(
                mins=self.mins.tolist(), maxs=self.maxs.tolist(), files=["means_l.webp", "means_u.webp"]
            ),
            scales=_Part(codebook=self.scale_codebook.tolist(), files=["scales.webp"]),
            quats=_Part(files=["quats.webp"]),
            sh0=_Part(codebook=self.color_codebook.tolist(), files=["sh0.webp"]),
            shN=harmonics,
        )
        return _pack_archive({**files, "meta.json": msgspec.json.encode(meta)})

    @classmethod
    def quantise(cls, model: Gaussians) -> Self:
        """See `Codes`. The palette has N / 2 to N vectors, at most 65,536."""
        means, quats, log_scales, opacities, f_dc, rest = arrays_of(model)
        n, k = rest.shape[:2]
        logs = np.copysign(np.log1p(np.abs(means.astype(np.float64))), means)
        mins, maxs = logs.min(axis=0), logs.max(axis=0)
        positions = (logs - mins) / np.where(maxs > mins, maxs - mins, 1.0) * _MAX_POSITION
        largest, others = smallest_three(quats)
        scale_codebook, color_codebook = codebook_of(log_scales), codebook_of(f_dc)
        sh_codebook, palette, labels = _no_harmonics(n)
        if k:
            size = min(_MAX_LABELS, 2 ** int(math.log2(n)))
            vectors, labels = palette_of(rest.reshape(n, 3 * k), size)
            sh_codebook = codebook_of(vectors)
            palette = nearest(sh_codebook, vectors).reshape(-1, k, 3)
        return cls(
            mins=mins,
            maxs=maxs,
            positions=to_bytes(positions, _MAX_POSITION),
            largest=largest,
            rotations=to_bytes((others * np.sqrt(2) + 1) / 2 * 255),
            scale_codebook=scale_codebook,
            scales=nearest(scale_codebook, log_scales),
            color_codebook=color_codebook,
            colors=nearest(color_codebook, f_dc),
            alphas=to_bytes(opacities * 255),
            sh_codebook=sh_codebook,
            palette=palette,
            labels=labels,
        )

    def decode_part(self, part: slice) -> Gaussians:
        rotations = (self.rotations[part] / 255 * 2 - 1) * np.sqrt(0.5)
        palette = self.palette[self.labels[part]]
        return gaussians_of(
            self.positions_at(self.positions[part]),
            from_smallest_three(self.largest[part], rotations),
            self.scale_codebook[self.scales[part]],
            self.alphas[part] / 255,
            self.color_codebook[self.colors[part]],
            self.sh_codebook[palette] if palette.size else np.empty((len(palette), 0, 3), np.float32),
        )

    def positions_at(self, levels: Numbers) -> Doubles:
        """[N, 3] world positions of codes `levels`, 0 to 65535, which may be fractional."""
        extent = np.where(self.maxs == self.mins, 1.0, self.maxs - self.mins)
        logs = self.mins + extent * (levels / _MAX_POSITION)
        with np.errstate(over="ignore"):
            values: Doubles = np.copysign(np.expm1(np.abs(logs)), logs)
        return values


def _no_harmonics(count: int) -> tuple[Floats, Bytes, Shorts]:
    """Codebook, palette and labels of degree 0."""
    return np.empty(0, np.float32), np.empty((1, 0, 3), np.uint8), np.zeros(count, np.uint16)


def _codebook(values: list[float]) -> Floats:
    """[256] finite numbers, padded with 0. Raises InputError."""
    if not 1 <= len(values) <= SIZE:
        raise damaged("SOG", f"expected codebooks of 1 to {SIZE} numbers, found {len(values):,}")
    with np.errstate(over="ignore"):
        numbers = np.pad(np.array(values, np.float64), (0, SIZE - len(values))).astype(np.float32)
    if not np.isfinite(numbers).all():
        raise damaged("SOG", "a codebook is not finite")
    return numbers


def _uint16(low: Bytes, high: Bytes) -> Shorts:
    """16-bit integers from their low and high bytes."""
    return low.astype(np.uint16) | (high.astype(np.uint16) << np.uint16(8))


def _rgba(colors: Numbers, alpha: Bytes | None = None) -> Bytes:
    """[M, 4] pixels from colours [M, 3], 0 to 255, and an alpha [M], by default 255."""
    pixels = np.full((len(colors), 4), 255, np.uint8)
    pixels[:, :3] = colors
    if alpha is not None:
        pixels[:, 3] = alpha
    return pixels


def _read_meta(data: bytes) -> _Meta:
    """A meta.json with all file names and bounds. Raises InputError."""
    if len(data) > _MAX_META_BYTES:
        raise InputError(f"expected a meta.json of at most {_MAX_META_BYTES:,} bytes, found {len(data):,}")
    try:
        version = msgspec.json.decode(data, type=_Version).version
        if version != 2:
            raise InputError(f"expected SOG of version 2, found {version}")
        meta = msgspec.json.decode(data, type=_Meta)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f"cannot parse the meta.json of a SOG: {reason(error)}") from error
    needed = [(meta.means.files, 2), (meta.scales.files, 1), (meta.quats.files, 1), (meta.sh0.files, 1)]
    needed += [(meta.shN.files, 2)] if meta.shN else []
    if any(len(files) < count for files, count in needed):
        raise InputError("the meta.json of a SOG names fewer images than it needs")
    if not len(meta.means.mins) == len(meta.means.maxs) == 3:
        raise InputError("the meta.json of a SOG has no bounds of three coordinates")
    return meta


def pack_unpacked(meta_file: Path) -> bytes:
    """The archive of an unpacked SOG: its meta.json with the images that it names beside it.

    Raises InputError, also for names outside the folder.
    """
    data = read_file(meta_file, _MAX_META_BYTES)
    meta = _read_meta(data)
    parts = [meta.means, meta.scales, meta.quats, meta.sh0, *([meta.shN] if meta.shN else [])]
    files = {"meta.json": data}
    for name in [name for part in parts for name in part.files][:_MAX_MEMBERS]:
        if Path(name).name != name or "\\" in name:
            raise InputError(f"{meta_file}: expected images beside it, found {name[:80]!r}")
        files[name] = read_file(meta_file.with_name(name), MAX_BYTES)
    return _pack_archive(files)


def _open_archive(data: bytes) -> Callable[[str], bytes]:
    """A function that reads a file in the archive by name. Both raise InputError.

    All files together may unpack to twice the size of the archive plus 1 MiB.
    """
    try:
        archive = zipfile.ZipFile(io.BytesIO(data))
    except _BROKEN as error:
        raise not_whole("SOG", reason(error)) from error
    members = archive.infolist()
    if len(members) > _MAX_MEMBERS:
        raise InputError(f"expected a SOG of at most {_MAX_MEMBERS} files, found {len(members):,}")
    if len({info.header_offset for info in members}) < len(members):
        raise damaged("SOG", "two of its files are at the same place")
    unpacked = sum(info.file_size for info in members)
    if unpacked > 2 * len(data) + _MAX_META_BYTES:
        raise damaged("SOG", f"{len(data):,} bytes that unpack to {unpacked:,}")

    def read(name: str) -> bytes:
        try:
            info = archive.getinfo(name)
            if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise damaged("SOG", f"{name[:80]!r} has an unsupported ZIP compression")
            with archive.open(info) as file:
                return file.read(info.file_size)
        except KeyError as error:
            raise InputError(
                f"not a SOG: there is no {name[:80]!r} in the archive; unpack it if it is another"
            ) from error
        except _BROKEN as error:
            raise damaged("SOG", f"{name[:80]!r}: {reason(error)}") from error

    return read


def _pack_archive(files: Mapping[str, bytes]) -> bytes:
    """An archive of files, stored, since they are compressed already."""
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_STORED) as archive:
        for name, content in files.items():
            archive.writestr(zipfile.ZipInfo(name, _DATE), content)
    return data.getvalue()


def _decode_webp(data: bytes, count: int, width: int | None = None) -> Bytes:
    """[count, 4] RGBA of the first pixels of a lossless WebP, of this `width` if given.

    Checks the size before decoding. Raises InputError.
    """
    size = _webp_size(data)
    area = size[0] * size[1]
    if area < count or (width is not None and size[0] != width):
        raise damaged("SOG", f"expected an image of {count:,} pixels, found {size[0]} x {size[1]}")
    if area > max(_SMALL_IMAGE, 4 * count):
        raise damaged("SOG", f"an image of {size[0]} x {size[1]} for {count:,} pixels")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(data), formats=("WEBP",)) as image:
                if image.size != size:
                    raise damaged("SOG", "an image with two sizes")
                decoded = np.asarray(image.convert("RGBA")).reshape(-1, 4)
    except (OSError, ValueError, SyntaxError, EOFError, MemoryError, Image.DecompressionBombError) as error:
        raise damaged("SOG", f"an image cannot be read: {reason(error)}") from error
    return decoded[:count]


def _encode_webp(values: Bytes, width: int, height: int) -> bytes:
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
        raise damaged("SOG", "an image is not WebP")
    if data[12:16] == b"VP8L":
        (bits,) = struct.unpack_from("<I", data, 21)
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    if data[12:16] == b"VP8X" and b"VP8L" in data[30:]:
        return int.from_bytes(data[24:27], "little") + 1, int.from_bytes(data[27:30], "little") + 1
    raise damaged("SOG", "expected lossless WebP images, found others")
