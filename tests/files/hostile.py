"""Files of a given size that cost their reader as much time or memory as they can.

    python tests/files/hostile.py                  # 1 MB each
    python tests/files/hostile.py --megabytes 16 --only glb

Prints the processor seconds, and the peak memory above the start in MiB and in bytes per byte of the file.
"""

from __future__ import annotations

import argparse
import io
import json
import struct
import sys
import tempfile
import time
import warnings
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))


import numpy as np
import zstandard

from files.formats.false_sizes import image
from files.formats.mutations import peak_memory
from files.scene_files import camera_bytes, counted, image_bytes, point_bytes
from keyss.core import InputError
from keyss.files import load_scene, read_model
from keyss.files.images import png_names
from keyss.files.ply_table import model_names, ply_header

SECONDS, MEMORY, PER_BYTE = 5.0, 200 << 20, 32
KHR = "KHR_gaussian_splatting"
Files = dict[str, bytes]  # by name; the first is read, or the folder if there are several


def glb(document: dict[str, Any], binary: bytes = b"") -> Files:
    document = {"asset": {"version": "2.0"}, "buffers": [{"byteLength": len(binary)}], **document}
    text = json.dumps(document, separators=(",", ":")).encode()
    chunks = (
        struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    )
    return {"a.glb": struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks}


def glb_nodes_and_primitives(size: int) -> Files:
    """Half the bytes are nodes, which share a mesh of as many primitives."""
    count = size // 40
    return glb(
        {"nodes": [{"mesh": 0}] * count, "meshes": [{"primitives": [{}] * (size // 12)}]},
        bytes(max(0, size - (1 << 20))),
    )


def glb_transforms(size: int) -> Files:
    size = min(size, 1_000_000)
    return glb(
        {"nodes": [{"rotation": [1, 0, 0, 0], "mesh": 0}] * (size // 34), "meshes": [{"primitives": []}]}
    )


def glb_roots(size: int) -> Files:
    size = min(size, 1_000_000)
    return glb({"nodes": [{}], "scenes": [{"nodes": [0] * (size // 2)}]})


def glb_accessors(components: str, kind: int, degrees: tuple[int, ...]) -> Callable[[int], Files]:
    """Accessors that share all bytes; each of `degrees` is a primitive, all but the first of one Gaussian."""

    def make(size: int) -> Files:
        width = np.dtype(components).itemsize
        accessors: list[dict[str, Any]] = []
        primitives: list[dict[str, Any]] = []
        most = 11 + 3 * (max(degrees) + 1) ** 2  # values of a Gaussian
        for number, degree in enumerate(degrees):
            count = min(4 * size // most, size // (4 * width)) if number == 0 else 1

            def accessor(of: str, count: int = count) -> int:
                accessors.append({"count": count, "type": of, "componentType": kind, "bufferView": 0})
                accessors[-1] |= {"normalized": True} if kind != 5126 else {}
                return len(accessors) - 1

            attributes = {"POSITION": accessor("VEC3"), f"{KHR}:ROTATION": accessor("VEC4")}
            attributes |= {f"{KHR}:SCALE": accessor("VEC3"), f"{KHR}:OPACITY": accessor("SCALAR")}
            for d in range(degree + 1):
                attributes |= {f"{KHR}:SH_DEGREE_{d}_COEF_{i}": accessor("VEC3") for i in range(2 * d + 1)}
            primitives.append({"attributes": attributes, "extensions": {KHR: {}}})
        binary = np.full(size // width, 0.5 if kind == 5126 else 100, components).tobytes()
        document = {"nodes": [{"mesh": 0}], "meshes": [{"primitives": primitives}], "accessors": accessors}
        return glb({**document, "bufferViews": [{"buffer": 0, "byteLength": len(binary)}]}, binary)

    return make


def spz(degree: int) -> Callable[[int], Files]:
    """As many Gaussians as the bytes may hold, all equal; the rest of the bytes are empty deflate blocks."""

    def make(size: int) -> Files:
        count = max(1 << 17, int(size / (6 if degree == 0 else 9.75)))
        body = bytes(count * (20 + 3 * ((degree + 1) ** 2 - 1)))
        packer = zlib.compressobj(6, zlib.DEFLATED, -15)
        header = struct.pack("<4sIIBBBB", b"NGSP", 3, count, degree, 12, 0, 0)
        start = packer.compress(header) + packer.flush(zlib.Z_FULL_FLUSH)
        rest = packer.compress(body) + packer.flush()
        padding = b"\0\0\0\xff\xff" * max(0, (size - len(start) - len(rest)) // 5 + 1)
        end = struct.pack("<II", zlib.crc32(header + body), len(header + body))
        return {"a.spz": b"\x1f\x8b\x08" + bytes(6) + b"\x03" + start + padding + rest + end}

    return make


def spz4(size: int) -> Files:
    count = max(1 << 17, int(size / 9.75))
    sizes = [count * each for each in (9, 1, 3, 3, 4, 45)]
    packed = [zstandard.ZstdCompressor().compress(bytes(size)) for size in sizes]
    pad = bytes(max(0, size - sum(map(len, packed))))
    header = struct.pack("<4sIIBBBB", b"NGSP", 4, count, 3, 12, 0, 6) + struct.pack(
        "<I12s", 32 + len(pad), b""
    )
    table = b"".join(struct.pack("<QQ", len(a), b) for a, b in zip(packed, sizes, strict=True))
    return {"a.spz": header + pad + table + b"".join(packed)}


def sog(bands: int) -> Callable[[int], Files]:
    def make(size: int) -> Files:
        count = max(1 << 17, size // (6 if bands == 0 else 10))
        k = (bands + 1) ** 2 - 1
        width = 4096
        height = min(16383, 4 * count // width)
        blank = image("WEBP", width, height, **BLANK)
        part = {"files": ["i", "i"], "mins": [0] * 3, "maxs": [1] * 3, "codebook": [0.5]}
        meta = {"version": 2, "count": count, **dict.fromkeys(("means", "scales", "quats", "sh0"), part)}
        files = {"i": blank}
        if k:
            files["p"] = image("WEBP", 64 * k, 1024, **BLANK)
            meta["shN"] = {"count": 65536, "bands": bands, "codebook": [0.5], "files": ["p", "i"]}
        data = io.BytesIO()
        with zipfile.ZipFile(data, "w") as archive:
            archive.writestr("meta.json", json.dumps(meta))
            for name, content in files.items():
                archive.writestr(name, content)
            archive.writestr("pad", bytes(max(0, size - sum(map(len, files.values())))))
        return {"a.sog": data.getvalue()}

    return make


BLANK = {"alpha": 255, "lossless": True, "exact": True, "quality": 0, "method": 0}


FLOATS = [f"float {name}" for name in model_names(1)]


def ply_rows(properties: list[str], width: int) -> Callable[[int], Files]:
    """Rows of `width` bytes."""

    def make(size: int) -> Files:
        count = size // width
        return {"a.ply": ply_header({"vertex": (count, properties)}) + b"\xff" * width * count}

    return make


def ply_elements(size: int) -> Files:
    """Thousands of elements without a byte."""
    many = {f"{i}": (9999999999, []) for i in range(2000)}
    header = ply_header({**many, "vertex": (size // 14, [f"char {name}" for name in model_names(1)])})
    return {"a.ply": header + b"\xff" * 14 * (size // 14)}


def ply_text(value: str, between: str = " ") -> Callable[[int], Files]:
    """Rows of equal numbers."""

    def make(size: int) -> Files:
        count = size // (14 * len(value + between))
        header = ply_header({"vertex": (count, FLOATS)}).replace(b"binary_little_endian", b"ascii")
        return {"a.ply": header + ((value + between) * 14 * count).encode()}

    return make


def ply_long_number(size: int) -> Files:
    header = ply_header({"vertex": (1, FLOATS)}).replace(b"binary_little_endian", b"ascii")
    return {"a.ply": header + b"1 " * 13 + b"1" * (size - 26)}


def compressed_ply(size: int) -> Files:
    """Without bytes for bounds, as far as that goes: all of it Gaussians with harmonics."""
    chunks = (size - 3000) // (16 + 45) // 256
    count, parts = 256 * chunks, ("x", "y", "z", "scale_x", "scale_y", "scale_z")
    elements = {
        "chunk": (chunks, [f"float {end}_{part}" for part in parts for end in ("min", "max")]),
        "vertex": (count, [f"uint packed_{name}" for name in ("position", "rotation", "scale", "color")]),
        "sh": (count, [f"uchar f_rest_{i}" for i in range(45)]),
    }
    rows = np.ones(12 * chunks, "<f4").tobytes() + bytes(count * 61)
    return {"a.compressed.ply": ply_header(elements) + rows}


def splat(size: int) -> Files:
    return {"a.splat": b"\1" * (size // 32 * 32)}


PHOTO = image("PNG", 16, 16)
CAMERA = counted(camera_bytes(params=(16, 16, 8, 8), width=16, height=16))


def colmap(
    images: bytes, *, cameras: bytes = CAMERA, points: bytes = b"", text: bool = False, **more: bytes
) -> Files:
    suffix = ".txt" if text else ".bin"
    files = {f"cameras{suffix}": cameras, f"images{suffix}": images}
    files |= {f"points3D{suffix}": points or (b"" if text else counted())}
    return files | {"images/0.png": PHOTO, "images/1.png": PHOTO} | more


TWO_IMAGES = counted(*(image_bytes(i, f"{i}.png", observations=0) for i in range(2)))


def colmap_short_names(size: int) -> Files:
    """As many images as bytes allow; all folders of images exist."""
    count = size // 80
    folders = {f"images_{n}/0.jpg": PHOTO for n in (2, 4, 8)} | {"masks/0.png": PHOTO}
    images = counted(*(image_bytes(i, f"{i:x}.P", observations=0) for i in range(count)))
    return colmap(images, **folders)


def colmap_dotted_names(part: str) -> Callable[[int], Files]:
    """Names of thousands of parts that all exist."""

    def make(size: int) -> Files:
        count = max(2, size // 4090)
        long = part * (4000 // len(part))
        images = counted(*(image_bytes(i, f"{long}{i}.png", observations=0) for i in range(count)))
        return colmap(images)

    return make


def colmap_points(size: int) -> Files:
    return colmap(TWO_IMAGES, points=counted(*[point_bytes(1, (1, 2, 3), track=())] * (size // 51)))


def colmap_cameras(size: int) -> Files:
    cameras = [camera_bytes(i, 0, (16, 8, 8), 16, 16) for i in range(size // 48)]
    return colmap(
        counted(*(image_bytes(i, f"{i}.png", observations=0, camera_id=0) for i in range(2))),
        cameras=counted(*cameras),
    )


TEXT_CAMERA = b"1 PINHOLE 16 16 16 16 8 8\n"
TEXT_IMAGES = b"".join(b"%d 1 0 0 0 0 0 4 1 %d.png\n\n" % (i, i) for i in range(2))


def colmap_text_points(size: int) -> Files:
    points = b"".join(b"%d .1 .2 .3 1 1 1 0\n" % i for i in range(size // 24))
    return colmap(TEXT_IMAGES, cameras=TEXT_CAMERA, points=points, text=True)


def colmap_text_lines(size: int) -> Files:
    emoji = "\N{GRINNING FACE}".encode()
    return colmap(
        TEXT_IMAGES, cameras=TEXT_CAMERA, points=b"#" + emoji + b"\n" + b"#\n" * (size // 2), text=True
    )


def colmap_text_names(size: int) -> Files:
    images = b"".join(b"%x 1 0 0 0 0 0 4 1 %x.P\n\n" % (i, i) for i in range(size // 32))
    return colmap(images, cameras=TEXT_CAMERA, text=True)


def colmap_text_name(size: int) -> Files:
    return colmap(
        b"1 1 0 0 0 0 0 4 1 " + b"./" * (size // 2) + b"0.png\n\n" + TEXT_IMAGES,
        cameras=TEXT_CAMERA,
        text=True,
    )


def transforms(name: str, content: bytes) -> Files:
    return {name: content, "0.png": PHOTO, "1.png": PHOTO}


def frames(frame: Callable[[int], str], length: int, name: str = "transforms.json") -> Callable[[int], Files]:
    def make(size: int) -> Files:
        listed = ",".join(map(frame, range(size // length)))
        return transforms(name, f'{{"w":16,"h":16,"fl_x":16,"frames":[{listed}]}}'.encode())

    return make


POSE = "[[1,0,0,0],[0,1,0,0],[0,0,1,0]]"


def json_values(values: str) -> Callable[[int], Files]:
    """Any JSON before the frames, after a character that takes four bytes in memory."""

    def make(size: int) -> Files:
        listed = ",".join([values] * (size // (len(values) + 1)))
        text = f'{{"x":"\N{GRINNING FACE}","y":[{listed}],"frames":[{{"file_path":"0.png"}}]}}'
        return transforms("transforms.json", text.encode())

    return make


def json_deep_path(size: int) -> Files:
    frame = json.dumps({"file_path": "/a" * (size // 2)})
    return transforms("transforms.json", f'{{"frames":[{frame}]}}'.encode())


def json_filenames(size: int) -> Files:
    own = ",".join(f'{{"file_path":"{i}.png","transform_matrix":{POSE}}}' for i in range(2))
    lists = ",".join(f'"{i:x}"' for i in range(size // 7))
    return transforms(
        "transforms.json",
        f'{{"w":16,"h":16,"fl_x":16,"frames":[{own}],"train_filenames":[{lists}]}}'.encode(),
    )


def png_stems(size: int) -> Files:
    """Photos of one name in as many folders."""
    count = size // (80 + len(PHOTO))
    listed = [f"{i:x}/a.png" for i in range(count)]
    images = counted(*(image_bytes(i, name, observations=0) for i, name in enumerate(listed)))
    scene = {each: data for each, data in colmap(images).items() if not each.startswith("images/")}
    return scene | {f"images/{name}": PHOTO for name in listed}


def json_points(size: int) -> Files:
    own = ",".join(f'{{"file_path":"{i}.png","transform_matrix":{POSE}}}' for i in range(2))
    found = transforms(
        "transforms.json", f'{{"w":16,"h":16,"fl_x":16,"ply_file_path":"p.ply","frames":[{own}]}}'.encode()
    )
    count = size // 3
    points = ply_header({"vertex": (count, [f"uchar {each}" for each in "xyz"])}) + bytes(3 * count)
    return found | {"p.ply": points}


def png(size: int) -> Files:
    """A photo of 24 million pixels, the most that a small file may have, twice."""
    big = image("PNG", 4896, 4896)
    cameras = counted(camera_bytes(params=(16, 16, 8, 8), width=4896, height=4896))
    return colmap(TWO_IMAGES, cameras=cameras) | {"images/0.png": big}


HOSTILE: dict[str, Callable[[int], Files]] = {
    "glb: nodes x primitives": glb_nodes_and_primitives,
    "glb: transforms": glb_transforms,
    "glb: roots": glb_roots,
    **{
        f"glb: shared bytes as {code}, degrees {degrees}": glb_accessors(code, kind, degrees)
        for code, kind in (("u1", 5121), ("<u2", 5123), ("<f4", 5126))
        for degrees in ((0,), (3,), (0, 3))
    },
    "spz: degree 0": spz(0),
    "spz: degree 3": spz(3),
    "spz: version 4": spz4,
    "sog: degree 0": sog(0),
    "sog: degree 3": sog(3),
    "ply: bytes": ply_rows([f"char {name}" for name in model_names(16)], 59),
    "ply: two types": ply_rows(["short x", *(f"char {name}" for name in model_names(16)[1:])], 60),
    "ply: properties": ply_rows(
        [f"char {name}" for name in (*model_names(1), *(f"p{i:04}" for i in range(2900)))], 2914
    ),
    "ply: elements": ply_elements,
    "ply: text in one line": ply_text("-1"),
    "ply: text, longer numbers": ply_text("-.1"),
    "ply: text, a line each": ply_text("-1", "\n"),
    "ply: a long number": ply_long_number,
    "compressed ply": compressed_ply,
    "splat": splat,
    "colmap: names": colmap_short_names,
    "colmap: names of dots": colmap_dotted_names("./"),
    "colmap: names of slashes": colmap_dotted_names("/"),
    "colmap: points": colmap_points,
    "colmap: cameras": colmap_cameras,
    "colmap text: points": colmap_text_points,
    "colmap text: lines": colmap_text_lines,
    "colmap text: names": colmap_text_names,
    "colmap text: a long name": colmap_text_name,
    "nerfstudio: frames": frames(lambda i: f'{{"file_path":"{i:x}"}}', 24),
    "nerfstudio: frames of one photo": frames(
        lambda i: f'{{"file_path":"0.png","transform_matrix":{POSE}}}', 75
    ),
    "nerfstudio: absolute paths": frames(lambda i: f'{{"file_path":"{"/a" * 1000}{i:x}"}}', 2024),
    "nerfstudio: short absolute paths": frames(lambda i: f'{{"file_path":"{"/a" * 20}{i:x}"}}', 64),
    "nerfstudio: one long path": json_deep_path,
    "nerfstudio: paths up and down": frames(lambda i: f'{{"file_path":"{"./" * 1000}{i:x}"}}', 2024),
    "nerfstudio: lists of names": json_filenames,
    "nerfstudio: points": json_points,
    "json: objects": json_values("{}"),
    "json: lists": json_values("[]"),
    "json: keys": json_values('{"a":[]}'),
    "blender: frames": frames(lambda i: f'{{"file_path":"{i:x}"}}', 24, "transforms_train.json"),
    "png: pixels": png,
    "png: names": png_stems,
}


@dataclass(frozen=True)
class Cost:
    """The cost of reading one file."""

    name: str
    bytes: int  # of all files
    seconds: float  # of the processor
    memory: int  # above the start, in bytes
    result: str

    @property
    def bounded(self) -> bool:
        return self.seconds <= SECONDS and self.memory <= MEMORY + PER_BYTE * self.bytes


def cost(name: str, size: int) -> Cost:
    """Write a hostile file and read it."""
    result = ""

    def read() -> None:
        nonlocal result
        try:
            result = "read"
            if path.is_dir():
                png_names(view.camera for view in load_scene(path).views)
            else:
                result = f"{len(read_model(path)):,} Gaussians"
        except InputError as error:
            result = str(error)

    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        total, path = 0, Path(folder)
        for each, data in (files := HOSTILE[name](size)).items():
            (path / each).parent.mkdir(parents=True, exist_ok=True)
            (path / each).write_bytes(data)
            total += len(data)
        if len(files) == 1:
            path /= each
        del files, data
        start = time.process_time()
        memory = peak_memory(read)
        return Cost(name, total, time.process_time() - start, memory, result)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--megabytes", type=float, default=1)
    parser.add_argument("--only", default="", help="start of the names of files")
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    exceeded = 0
    for name in [each for each in HOSTILE if each.startswith(asked.only)]:
        cost(name, 10_000)  # imports and compiles what the format needs
        found = cost(name, round(asked.megabytes * 1e6))
        exceeded += not found.bounded
        mebibytes, share = found.memory >> 20, found.memory / found.bytes
        line = f"{name:40} {found.seconds:6.2f} s {mebibytes:6,} MiB {share:6.1f}  {found.result[:80]!r}"
        print(json.dumps(asdict(found)) if asked.json else line + " !" * (not found.bounded), flush=True)
    return min(exceeded, 1)


if __name__ == "__main__":
    sys.exit(main())
