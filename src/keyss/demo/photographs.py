"""Procedural demo scenes: posed images and sparse points of two little worlds, with nothing to download."""

from __future__ import annotations

import io
import json
import math
import os
import shutil
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from keyss.core.errors import OutputError, UsageError
from keyss.demo.ray_tracer import Floats, Vector, World, trace
from keyss.demo.worlds import golden_knot, tea_table
from keyss.files.atomic import write_bytes

_POINTS = 3000
_POINT_NOISE = 0.002  # standard deviation over distance, about that of a good reconstruction
_FIELD_OF_VIEW = math.radians(44)  # across the image's width
_DISTANCE = 4.2
_ELEVATIONS = tuple(math.radians(angle) for angle in (17, 33, 50))
_EDGE = 0.08  # of full brightness: pixels that differ more from a neighbour get four rays
_SUBPIXELS = ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25))
_BATCH = 1 << 18  # pixels rendered at once


@dataclass(frozen=True)
class _Demo:
    world: Callable[[int], World]
    target: Vector  # what the cameras look at


_DEMOS = {
    "tea-table": _Demo(tea_table, (0.0, 0.0, 0.15)),
    "golden-knot": _Demo(golden_knot, (0.0, 0.0, 0.6)),
}
DEMO_SCENES = tuple(_DEMOS)


def write_demo_scene(
    folder: Path | str,
    which: str,
    *,
    views: int = 48,
    width: int = 192,
    height: int = 144,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Render one of `DEMO_SCENES` into a new folder in Nerfstudio's layout.

    The folder holds `transforms.json`, `images/0000.png`, ... (RGB, `width` x `height`) and `points.ply`
    with 3,000 coloured points of the surfaces. The cameras stand on three rings around the scene; `seed`
    varies the textures, the cameras and the points. One seed gives the same bytes every time. `progress`
    is called with (views rendered, views) now and then.

    The folder appears only when it is complete. Raises UsageError for an unknown scene, fewer than 8
    views or images smaller than 16 pixels, and OutputError when the folder exists and is not empty or
    cannot be written.
    """
    if which not in _DEMOS:
        raise UsageError(f"expected a demo scene of {', '.join(DEMO_SCENES)}, got {which!r}")
    if views < 8 or width < 16 or height < 16:
        raise UsageError(
            f"expected at least 8 views of at least 16 x 16 pixels, got {views} views of {width} x {height}"
        )
    if seed < 0:
        raise UsageError(f"expected a seed of 0 or more, got {seed}")
    folder = Path(folder)
    try:
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise OutputError(f"{folder} exists already; choose another folder or remove it first")
        folder.parent.mkdir(parents=True, exist_ok=True)
        partial = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
        try:
            _write(partial, _DEMOS[which], views, width, height, seed, progress)
            partial.chmod(0o777 & ~_umask())
            if folder.exists():
                folder.rmdir()
            partial.rename(folder)
        except BaseException:
            shutil.rmtree(partial, ignore_errors=True)
            raise
    except OSError as error:
        raise OutputError(f"cannot write {folder}: {error.strerror or error}") from error


def _write(
    folder: Path,
    demo: _Demo,
    views: int,
    width: int,
    height: int,
    seed: int,
    progress: Callable[[int, int], None] | None,
) -> None:
    rng = np.random.default_rng(seed)
    world = demo.world(seed)
    poses = _poses(demo.target, views, rng)
    focal = 0.5 * width / math.tan(0.5 * _FIELD_OF_VIEW)
    (folder / "images").mkdir()

    images = np.empty((views, height, width, 3), dtype=np.uint8)
    step = max(1, _BATCH // (width * height))
    batches = [poses[start : start + step] for start in range(0, views, step)]
    done = 0
    # numpy lets go of the interpreter in its loops, so threads do help.
    with ThreadPoolExecutor(min(4, os.cpu_count() or 1)) as pool:
        for batch in pool.map(lambda batch: _photos(world, batch, focal, width, height), batches):
            for image in batch:
                write_bytes(folder / _image_name(done), _png(image))
                images[done] = image
                done += 1
            if progress:
                progress(done, views)
    write_bytes(folder / "points.ply", _sparse_points(world, poses, focal, images, rng))
    transforms = {
        "camera_model": "PINHOLE",
        "w": width,
        "h": height,
        "fl_x": focal,
        "fl_y": focal,
        "cx": width / 2,
        "cy": height / 2,
        "ply_file_path": "points.ply",
        "frames": [
            {"file_path": _image_name(index), "transform_matrix": pose.tolist()}
            for index, pose in enumerate(poses)
        ],
    }
    write_bytes(folder / "transforms.json", (json.dumps(transforms, indent=1) + "\n").encode())


def _poses(target: Vector, views: int, rng: np.random.Generator) -> list[NDArray[np.float64]]:
    """Camera-to-world matrices [4, 4] in OpenGL axes: one turn, the three heights in alternation."""
    poses = []
    for index in range(views):
        azimuth = 2 * math.pi * (index + rng.uniform(-0.3, 0.3)) / views
        elevation = _ELEVATIONS[index % len(_ELEVATIONS)] + rng.uniform(-0.04, 0.04)
        outward = np.array(
            [
                math.cos(azimuth) * math.cos(elevation),
                math.sin(azimuth) * math.cos(elevation),
                math.sin(elevation),
            ]
        )
        right = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(outward, right), outward], axis=1)
        pose[:3, 3] = np.array(target) + _DISTANCE * rng.uniform(0.96, 1.04) * outward
        poses.append(pose)
    return poses


def _photos(
    world: World, poses: list[NDArray[np.float64]], focal: float, width: int, height: int
) -> NDArray[np.uint8]:
    """[V, H, W, 3] sRGB: one ray per pixel, four where the neighbours differ.

    Several views at once, because numpy takes longer to begin with a short array than to work through it.
    """
    rows, columns = (0.5 + index.astype(np.float64) for index in np.mgrid[0:height, 0:width])
    rays = [_rays(pose, focal, width, height, columns, rows) for pose in poses]
    colors = _traced(world, rays).reshape(3, len(poses), height, width)
    images = np.ascontiguousarray(colors.transpose(1, 0, 2, 3))
    edges = [_contrast(image) > _EDGE for image in images]
    rays = []
    for pose, edge in zip(poses, edges, strict=True):
        finer_columns = np.concatenate([columns[edge] + dx for dx, _ in _SUBPIXELS])
        finer_rows = np.concatenate([rows[edge] + dy for _, dy in _SUBPIXELS])
        rays.append(_rays(pose, focal, width, height, finer_columns, finer_rows))
    finer = np.split(_traced(world, rays), np.cumsum([origins.shape[1] for origins, _ in rays])[:-1], axis=1)
    for image, edge, samples in zip(images, edges, finer, strict=True):
        image[:, edge] = samples.reshape(3, len(_SUBPIXELS), -1).mean(axis=1)
    return np.asarray(np.rint(255 * images.transpose(0, 2, 3, 1)), dtype=np.uint8)


def _traced(world: World, rays: list[tuple[Floats, Floats]]) -> Floats:
    """[3, M] sRGB colours of rays of several cameras."""
    origins, directions = (np.concatenate(parts, axis=1) for parts in zip(*rays, strict=True))
    return trace(world, origins, directions)[0]


def _contrast(image: Floats) -> Floats:
    """[H, W] largest difference of any channel within each pixel's 3 x 3 neighbourhood."""
    padded = np.pad(image, ((0, 0), (1, 1), (1, 1)), mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, (3, 3), axis=(1, 2))
    contrast: Floats = (windows.max(axis=(3, 4)) - windows.min(axis=(3, 4))).max(axis=0)
    return contrast


def _rays(
    pose: NDArray[np.float64],
    focal: float,
    width: int,
    height: int,
    columns: NDArray[np.floating],
    rows: NDArray[np.floating],
) -> tuple[Floats, Floats]:
    """([3, M] origins, [3, M] unit directions) through image points in pixels."""
    in_camera = np.stack(
        [
            (columns.ravel() - width / 2) / focal,
            (height / 2 - rows.ravel()) / focal,
            np.full(columns.size, -1.0),
        ]
    )
    in_camera /= np.linalg.norm(in_camera, axis=0)
    axes = pose[:3, :3]
    # Spelled out because the last digits of a matrix product depend on the number of threads.
    directions = axes[:, :1] * in_camera[0] + axes[:, 1:2] * in_camera[1] + axes[:, 2:] * in_camera[2]
    origins = np.repeat(pose[:3, 3:], columns.size, axis=1)
    return origins.astype(np.float32), directions.astype(np.float32)


def _sparse_points(
    world: World,
    poses: list[NDArray[np.float64]],
    focal: float,
    images: NDArray[np.uint8],
    rng: np.random.Generator,
) -> bytes:
    """A point cloud PLY of what random pixels show, a little off like a reconstruction."""
    views, height, width, _ = images.shape
    vertices = np.empty(
        _POINTS,
        dtype=[(axis, "<f4") for axis in "xyz"] + [(color, "u1") for color in ("red", "green", "blue")],
    )
    owners = np.arange(_POINTS) % views
    for view, pose in enumerate(poses):
        chosen = np.flatnonzero(owners == view)
        rows, columns = rng.integers(0, height, chosen.size), rng.integers(0, width, chosen.size)
        origins, directions = _rays(pose, focal, width, height, columns + 0.5, rows + 0.5)
        _, points = trace(world, origins, directions)
        distances = np.linalg.norm(points - origins, axis=0)
        points = points + _POINT_NOISE * distances * rng.normal(size=points.shape)
        for axis, values in zip("xyz", points, strict=True):
            vertices[axis][chosen] = values
        for channel, color in enumerate(("red", "green", "blue")):
            vertices[color][chosen] = images[view, rows, columns, channel]
    properties = [f"property float {axis}\n" for axis in "xyz"]
    properties += [f"property uchar {color}\n" for color in ("red", "green", "blue")]
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {_POINTS}\n{''.join(properties)}end_header\n"
    )
    return header.encode() + vertices.tobytes()


def _png(image: NDArray[np.uint8]) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="PNG")
    return buffer.getvalue()


def _image_name(index: int) -> str:
    return f"images/{index:04d}.png"


def _umask() -> int:
    umask = os.umask(0)
    os.umask(umask)
    return umask
