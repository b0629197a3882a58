"""Files with false sizes: counts, lengths, offsets and dimensions that formats declare."""

from __future__ import annotations

import gzip
import io
import json
import re
import struct
import zipfile
import zlib
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import zstandard
from PIL import Image

Random = np.random.Generator
MEBIBYTE, BOMB = 1 << 20, 1 << 29  # bytes
_CLAIMS = (0, 1, 60, 255, 1 << 16, (1 << 17) - 1, 1 << 17, (1 << 17) + 1, 1 << 20, 10**7, 1 << 27, 1 << 30)
_LIMITS = (2**31 - 1, 2**31, 2**32 - 2, 2**32 - 1, 2**53, 2**63, 2**64 - 1)


def claim(rng: Random, bits: int = 32) -> int:
    """A size for a field of `bits`."""
    return min(int(rng.choice(np.array(_CLAIMS + _LIMITS, np.uint64))), 2**bits - 1)


def zeros(rng: Random) -> bytes:
    """Up to 2 MiB of zeros, rarely up to 64."""
    return bytes(int(rng.integers(0, MEBIBYTE << int(rng.choice([0, 1, 6], p=[0.6, 0.39, 0.01])))))


@cache
def bomb() -> bytes:
    """A deflated stream of `BOMB` zeros."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    return packer.compress(bytes(BOMB)) + packer.flush()


def ply(data: bytes, rng: Random) -> bytes:
    """Other counts, elements and types in the header, before the old or other data."""
    header, _, body = data.partition(b"end_header\n")
    for _ in range(int(rng.integers(1, 4))):
        count = str(claim(rng, int(rng.choice([17, 32, 63])))).encode()
        match int(rng.integers(0, 6)):
            case 0 | 1:
                spans = list(re.finditer(rb"element \S+ ([0-9]+)", header))
                start, end = spans[rng.integers(len(spans))].span(1)
                header = header[:start] + count + header[end:]
            case 2:  # rows that take no bytes
                header += b"element nothing %s\n" % count
            case 3:
                header = re.sub(rb"property \S+ ", b"property uchar ", header)
            case 4:
                header = header.replace(b"binary_little_endian", b"ascii")
            case 5:
                header += b"".join(b"property uchar more_%d\n" % i for i in range(500))
    return header + b"end_header\n" + (body if rng.random() < 0.5 else zeros(rng))


def spz(data: bytes, rng: Random) -> bytes:
    """Version 3: a false header, or more or less data than it declares."""
    content = bytearray(gzip.decompress(data))
    if rng.random() < 0.7:
        struct.pack_into("<I", content, 8, claim(rng))
    if rng.random() < 0.5:
        content[12:15] = bytes(rng.integers(0, 5, 3).tolist())
    return gzip.compress(bytes(content) + zeros(rng), int(rng.integers(1, 7)))


def spz4(data: bytes, rng: Random) -> bytes:
    """Version 4: false sizes of the header, the table and frames."""
    count, degree, streams = struct.unpack_from("<I", data, 8)[0], data[12], data[15]
    if rng.random() < 0.5:
        count = claim(rng)
    if rng.random() < 0.3:
        degree = int(rng.integers(0, 4))
    header = bytearray(data[:32])
    struct.pack_into("<I", header, 8, count)
    header[12] = degree
    header[15] = streams if rng.random() < 0.7 else int(rng.integers(0, 256))
    struct.pack_into("<I", header, 16, 32 if rng.random() < 0.7 else claim(rng))
    table, frames = b"", b""
    for each in (9, 1, 3, 3, 4, 3 * ((degree + 1) ** 2 - 1))[: 5 + (degree > 0)]:
        frame = _frame(rng, min(count * each, 1 << 22))
        packed = len(frame) if rng.random() < 0.8 else claim(rng, 64)
        table += struct.pack("<QQ", packed, count * each if rng.random() < 0.8 else claim(rng, 64))
        frames += frame
    return bytes(header) + table + frames


def _frame(rng: Random, size: int) -> bytes:
    """A zstd frame of `size` zeros, or one whose header declares another window and size."""
    if rng.random() < 0.5:
        return zstandard.ZstdCompressor().compress(bytes(size))
    window = int(rng.integers(0, 256))  # the exponent less 10, times 8
    run = struct.pack("<I", 1 | 1 << 1 | min(size, 1 << 17) << 3)[:3] + b"\0"
    return b"\x28\xb5\x2f\xfd" + bytes([0xC0, window]) + struct.pack("<Q", claim(rng, 64)) + run


def sog(data: bytes, rng: Random) -> bytes:
    """A false meta.json, images or directory."""
    with zipfile.ZipFile(io.BytesIO(data)) as old:
        files = {name: old.read(name) for name in old.namelist()}
    meta = json.loads(files["meta.json"])
    if rng.random() < 0.4:
        meta["count"] = claim(rng, int(rng.choice([17, 32, 63])))
    if rng.random() < 0.2 and "shN" in meta:
        meta["shN"] |= {"count": claim(rng, 32), "bands": int(rng.integers(0, 5))}
    if rng.random() < 0.1:
        meta["scales"]["codebook"] = [0] * int(rng.integers(0, 400_000))
    files["meta.json"] = json.dumps(meta).encode()
    for name in [file for file in files if file.endswith(".webp") and rng.random() < 0.3]:
        files[name] = webp(files[name], rng)
    return _archive(files, rng)


def webp(data: bytes, rng: Random) -> bytes:
    """Another width and height, true or not, in a lossless image or in the extended header before it."""
    width, height = (int(rng.choice([1, 16, 256, 960, 2048, 16383])) for _ in range(2))
    if rng.random() < 0.5 and width * height < 1 << 22:
        return image("WEBP", width, height, lossless=True, quality=0, method=0)
    changed = bytearray(data)
    struct.pack_into("<I", changed, 21, width - 1 | height - 1 << 14)
    if rng.random() < 0.5:
        return bytes(changed)
    body = (data if rng.random() < 0.5 else bytes(changed))[12:]
    size = struct.pack("<II", width - 1, height - 1)
    extended = b"VP8X" + struct.pack("<I", 10) + bytes(4) + size[:3] + size[4:7]
    return b"RIFF" + struct.pack("<I", len(body) + len(extended) + 4) + b"WEBP" + extended + body


def _archive(files: dict[str, bytes], rng: Random) -> bytes:
    """A ZIP whose directory may declare other sizes and offsets, and missing or shared files."""
    found, kind = io.BytesIO(), int(rng.choice([zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED]))
    with zipfile.ZipFile(found, "w", kind) as archive:
        for name, content in files.items():
            archive.writestr(name, bomb() if rng.random() < 0.05 else content)
            if archive.filelist[-1].file_size == len(bomb()):
                archive.filelist[-1].compress_type = zipfile.ZIP_DEFLATED
                archive.filelist[-1].file_size = BOMB if rng.random() < 0.8 else claim(rng)
        if rng.random() < 0.3:
            archive.writestr("junk", b"")
            archive.filelist[-1].compress_size = claim(rng)
        shared = archive.getinfo(str(rng.choice(archive.namelist())))
        for entry in archive.filelist:
            for field in ("compress_size", "file_size", "header_offset"):
                if rng.random() < 0.05:
                    setattr(entry, field, claim(rng))
        for number in range(int(rng.choice([0, 1, 51, 2000], p=[0.6, 0.3, 0.09, 0.01]))):
            again = zipfile.ZipInfo(f"{number}" if number else "means_u.webp")
            for field in ("compress_type", "compress_size", "file_size", "CRC", "header_offset"):
                setattr(again, field, getattr(shared, field))
            archive.filelist.append(again)
    return found.getvalue()


def glb(data: bytes, rng: Random) -> bytes:
    """False accessors, views, nodes and chunks, or small JSON that takes much memory."""
    (size,) = struct.unpack_from("<I", data, 12)
    document, binary = json.loads(data[20 : 20 + size]), data[28 + size :]
    for _ in range(int(rng.integers(1, 4))):
        kind = str(rng.choice(["accessors", "bufferViews", "buffers"]))
        fields = {
            "accessors": ("count", "byteOffset", "bufferView", "componentType"),
            "bufferViews": ("byteOffset", "byteLength", "byteStride"),
            "buffers": ("byteLength",),
        }[kind]
        for each in document[kind] if rng.random() < 0.5 else [rng.choice(document[kind])]:
            each[str(rng.choice(fields))] = claim(rng, int(rng.choice([17, 32, 63])))
    parts: dict[str, Any] = {
        "nodes": [{}, {"mesh": 0}, {"children": [1] * 9}],
        "meshes": [{"primitives": [{}] * 9}],
        "scenes": [{}],
        "bufferViews": [{"buffer": 0}],
        "extensionsUsed": [""],
    }
    if rng.random() < 0.4:
        name = str(rng.choice(list(parts)))
        often = 10 ** int(rng.integers(1, 7))
        document[name] = document.get(name, []) + [rng.choice(parts[name])] * often
        document["scenes"][0]["nodes"] = list(range(min(often, len(document["nodes"]))))
    text = json.dumps(document, separators=(",", ":")).encode()
    sizes = [claim(rng) if rng.random() < 0.1 else each for each in (len(text), len(binary))]
    chunks = struct.pack("<I4s", sizes[0], b"JSON") + text + struct.pack("<I4s", sizes[1], b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks) if rng.random() < 0.9 else claim(rng)) + chunks


def safetensors(data: bytes, rng: Random) -> bytes:
    """False shapes, offsets and header length, or very many empty tensors."""
    (size,) = struct.unpack_from("<Q", data)
    header, body = json.loads(data[8 : 8 + size]), data[8 + size :]
    names = [name for name in header if name != "__metadata__"]
    for name in names if rng.random() < 0.3 else [str(rng.choice(names))]:
        if rng.random() < 0.5:
            header[name]["shape"] = [claim(rng, 63) for _ in range(int(rng.integers(1, 4)))]
        else:
            header[name]["data_offsets"] = sorted(claim(rng, 63) for _ in range(2))
    if rng.random() < 0.3:
        end = max(each["data_offsets"][1] for name, each in header.items() if name in names)
        often = 10 ** int(rng.integers(1, 6))
        header |= {f"{i}": {"dtype": "F32", "shape": [0], "data_offsets": [end, end]} for i in range(often)}
    text = json.dumps(header, separators=(",", ":")).encode()
    return struct.pack("<Q", len(text) if rng.random() < 0.8 else claim(rng, 64)) + text + body


def payload(data: bytes, rng: Random) -> bytes:
    """A carried secret that declares another number of Gaussians or another degree."""
    changed = bytearray(data)
    struct.pack_into("<IB", changed, 0, claim(rng), int(rng.integers(0, 4)))
    return bytes(changed) + (zeros(rng) if rng.random() < 0.5 else b"")


def image(kind: str, width: int, height: int, alpha: int = 0, **options: Any) -> bytes:
    """A black image, a few bytes at any size."""
    found = io.BytesIO()
    Image.new("RGBA", (width, height), (0, 0, 0, alpha)).save(found, kind, **options)
    return found.getvalue()


def png(data: bytes, rng: Random) -> bytes:
    """A PNG of a few bytes whose header declares any size, true or false."""
    width, height = (int(rng.choice([1, 255, 1024, 2048, 4096, 9400, 65535, 2**31 - 1])) for _ in range(2))
    if rng.random() < 0.1 and width * height <= 1 << 25:
        return image("PNG", width, height)
    depth, color = ((8, 2), (8, 6), (16, 0), (16, 6), (1, 0))[rng.integers(5)]
    chunk = b"IHDR" + struct.pack(">IIBBBBB", width, height, depth, color, 0, 0, 0)
    return data[:12] + chunk + struct.pack(">I", zlib.crc32(chunk)) + data[33:]


def colmap(data: bytes, rng: Random) -> bytes:
    """A cameras.bin, images.bin or points3D.bin with false counts."""
    changed = bytearray(data if rng.random() < 0.5 else data + zeros(rng))
    at = 0 if rng.random() < 0.5 else int(rng.integers(8, len(data) - 8))
    struct.pack_into("<Q", changed, at, claim(rng, 64))
    return bytes(changed)


FALSE_SIZES: dict[str, Callable[[bytes, Random], bytes]] = {
    "a.ply": ply,
    "a.compressed.ply": ply,
    "a.spz": lambda data, rng: (spz4 if data.startswith(b"NGSP") else spz)(data, rng),
    "a.sog": sog,
    "a.glb": glb,
    "a.3dgs.safetensors": safetensors,
    "a.payload": payload,
    "a.tensors": safetensors,
    "a.png": png,
    "cameras.bin": colmap,
    "images.bin": colmap,
    "points3D.bin": colmap,
}
