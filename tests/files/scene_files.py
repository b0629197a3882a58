"""Tiny valid scenes on disk, and random damage."""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

WIDTH, HEIGHT = 12, 8
PINHOLE = (1, (10.0, 11.0, 6.0, 4.0))  # model number, parameters


def photo(seed: int, channels: int = 3, size: tuple[int, int] = (WIDTH, HEIGHT)) -> np.ndarray:
    """Random [H, W, channels] bytes."""
    shape = (size[1], size[0], channels)
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


def save(path: Path, pixels: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)


def camera_bytes(
    camera_id: int = 1,
    model: int = PINHOLE[0],
    params: Sequence[float] = PINHOLE[1],
    width: int = WIDTH,
    height: int = HEIGHT,
) -> bytes:
    return struct.pack(f"<IiQQ{len(params)}d", camera_id, model, width, height, *params)


def image_bytes(
    image_id: int,
    name: str,
    quaternion: Sequence[float] = (1, 0, 0, 0),
    translation: Sequence[float] = (0, 0, 4),
    camera_id: int = 1,
    observations: int = 2,
) -> bytes:
    head = struct.pack("<I7dI", image_id, *quaternion, *translation, camera_id) + name.encode() + b"\0"
    seen = [struct.pack("<ddQ", 1.5, 2.5, 2**64 - 1)] * observations
    return head + struct.pack("<Q", observations) + b"".join(seen)


def point_bytes(
    point_id: int,
    xyz: Sequence[float],
    rgb: Sequence[int] = (1, 2, 3),
    track: Sequence[tuple[int, int]] = ((1, 0),),
) -> bytes:
    ends = b"".join(struct.pack("<II", *element) for element in track)
    return struct.pack("<QdddBBBdQ", point_id, *xyz, *rgb, 0.5, len(track)) + ends


def counted(*records: bytes) -> bytes:
    return struct.pack("<Q", len(records)) + b"".join(records)


def write_colmap(folder: Path, count: int = 3, model: str = "sparse/0", **replaced: bytes) -> Path:
    """A COLMAP scene of `count` images; `cameras=`, `images=` and `points3D=` replace a file's bytes."""
    names = [f"{i:02}.png" for i in range(count)]
    for i, name in enumerate(names):
        save(folder / "images" / name, photo(i))
    files = {
        "cameras": counted(camera_bytes()),
        "images": counted(*(image_bytes(i + 1, name, (1, 0, 0.1 * i, 0)) for i, name in enumerate(names))),
        "points3D": counted(
            point_bytes(7, (1, 2, 3)), point_bytes(3, (-1, 0, 1), (255, 0, 9), ((1, 1), (2, 1), (3, 1)))
        ),
    } | replaced
    (folder / model).mkdir(parents=True, exist_ok=True)
    for name, data in files.items():
        (folder / model / f"{name}.bin").write_bytes(data)
    return folder


def look_at_origin(angle: float, distance: float = 4.0) -> list[list[float]]:
    """An OpenGL camera-to-world matrix on a circle around the origin; z is up."""
    c, s = float(np.cos(angle)), float(np.sin(angle))
    return [[-s, 0.0, c, distance * c], [c, 0.0, s, distance * s], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]


def frames(paths: Sequence[str]) -> list[dict[str, Any]]:
    return [{"file_path": path, "transform_matrix": look_at_origin(0.3 * i)} for i, path in enumerate(paths)]


def write_json(path: Path, value: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value))


def write_blender(
    folder: Path, splits: Sequence[str] = ("train", "test"), count: int = 2, channels: int = 4
) -> Path:
    for split in splits:
        for i in range(count):
            save(folder / split / f"r_{i}.png", photo(i, channels))
        meta = {"camera_angle_x": 0.7, "frames": frames([f"./{split}/r_{i}" for i in range(count)])}
        write_json(folder / f"transforms_{split}.json", meta)
    return folder


def write_nerfstudio(folder: Path, count: int = 3, **extra: object) -> Path:
    """A Nerfstudio scene; keys given as None are left out of transforms.json."""
    paths = [f"images/frame_{i:05}.png" for i in range(count)]
    for i, path in enumerate(paths):
        save(folder / path, photo(i))
    meta: dict[str, object] = {
        "camera_model": "OPENCV",
        "w": WIDTH,
        "h": HEIGHT,
        "fl_x": 10.0,
        "fl_y": 11.0,
        "cx": 6.5,
        "cy": 4.0,
        "frames": frames(paths),
    }
    write_json(folder / "transforms.json", {k: v for k, v in (meta | extra).items() if v is not None})
    return folder
