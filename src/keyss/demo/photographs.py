"""Procedural demo scenes: posed images and sparse points of two little worlds, with nothing to download."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter

from keyss.core.errors import OutputError, UsageError
from keyss.demo.ray_shapes import Floats, Vector
from keyss.demo.ray_tracer import World, trace
from keyss.demo.worlds import golden_knot, tea_table
from keyss.files.atomic import write_bytes
from keyss.files.images import png_bytes
from keyss.files.ply_table import ply_header

_POINTS = 3000
_POINT_NOISE = 0.002  # standard deviation over distance, about that of a good reconstruction
_FIELD_OF_VIEW = math.radians(44)  # across the image's width
_DISTANCE = 4.2
_ELEVATIONS = tuple(math.radians(angle) for angle in (17, 33, 50))
_EDGE = 0.08  # of full brightness: pixels that differ more from a neighbour get four rays
_SUBPIXELS = ((-0.25, 0.25, -0.25, 0.25), (-0.25, -0.25, 0.25, 0.25))  # columns, rows
_COLORS = ("red", "green", "blue")
_BATCH = 1 << 18  # pixels rendered at once

# By name: the world of a seed, and what the cameras look at.
_DEMOS: dict[str, tuple[Callable[[int], World], Vector]] = {
    "tea-table": (tea_table, (0.0, 0.0, 0.15)),
    "golden-knot": (golden_knot, (0.0, 0.0, 0.6)),
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

    Nothing is written before all is rendered. Raises UsageError for an unknown scene, fewer than 8 views or
    images smaller than 16 pixels, and OutputError when the folder exists and is not empty or cannot be
    written.
    """
    if which not in _DEMOS:
        raise UsageError(f"expected a demo scene of {', '.join(DEMO_SCENES)}, got {which!r}")
    if views < 8 or width < 16 or height < 16:
        raise UsageError(f"expected at least 8 views of 16 x 16 pixels, got {views} of {width} x {height}")
    if seed < 0:
        raise UsageError(f"expected a seed of 0 or more, got {seed}")
    folder = Path(folder)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise OutputError(f"{folder} exists: choose another folder")
    make_world, target = _DEMOS[which]
    rng = np.random.default_rng(seed)
    studio = _Studio(make_world(seed), _poses(target, views, rng), width, height)
    images = studio.photos(progress)
    names = [f"images/{index:04d}.png" for index in range(views)]
    files = {name: png_bytes(torch.from_numpy(image)) for name, image in zip(names, images, strict=True)}
    files |= {"points.ply": studio.points(images, rng), "transforms.json": studio.transforms(names)}
    try:
        (folder / "images").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot create {folder}: {error.strerror}") from error
    for name, data in files.items():
        write_bytes(folder / name, data)


def _poses(target: Vector, views: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """[V, 4, 4] camera to world in OpenGL axes: one turn around `target`, three heights in alternation."""
    poses = np.tile(np.eye(4), (views, 1, 1))
    for index, pose in enumerate(poses):
        azimuth = 2 * math.pi * (index + rng.uniform(-0.3, 0.3)) / views
        elevation = _ELEVATIONS[index % len(_ELEVATIONS)] + rng.uniform(-0.04, 0.04)
        right = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
        level = np.array([math.cos(azimuth), math.sin(azimuth), 1.0])
        outward = level * [math.cos(elevation), math.cos(elevation), math.sin(elevation)]
        pose[:3, :3] = np.stack([right, np.cross(outward, right), outward], axis=1)
        pose[:3, 3] = np.array(target) + _DISTANCE * rng.uniform(0.96, 1.04) * outward
    return poses


@dataclass(frozen=True)
class _Studio:
    """A world, and the cameras that take photos of it."""

    world: World
    poses: NDArray[np.float64]  # [V, 4, 4]
    width: int  # of each photo in pixels
    height: int

    @property
    def focal(self) -> float:
        """Focal length in pixels."""
        return 0.5 * self.width / math.tan(0.5 * _FIELD_OF_VIEW)

    def photos(self, progress: Callable[[int, int], None] | None) -> NDArray[np.uint8]:
        """[V, H, W, 3] sRGB.

        Several views at once, because numpy takes longer to begin with a short array than to work through it.
        """
        step, images = max(1, _BATCH // (self.width * self.height)), []
        batches = (self.poses[start : start + step] for start in range(0, len(self.poses), step))
        # numpy lets go of the interpreter in its loops, so threads do help.
        with ThreadPoolExecutor(min(4, os.cpu_count() or 1)) as pool:
            for batch in pool.map(self._batch, batches):
                images += [*batch]
                if progress:
                    progress(len(images), len(self.poses))
        return np.stack(images)

    def _batch(self, poses: NDArray[np.float64]) -> NDArray[np.uint8]:
        """[V, H, W, 3]: one ray per pixel, four where the neighbours differ."""
        rows, columns = np.mgrid[0 : self.height, 0 : self.width] + 0.5
        colors = self._traced([self._rays(pose, columns, rows) for pose in poses])
        images = np.stack(colors).reshape(-1, 3, self.height, self.width)
        highest, lowest = (f(images, (1, 1, 3, 3), mode="nearest") for f in (maximum_filter, minimum_filter))
        edges = (highest - lowest).max(axis=1) > _EDGE  # [V, H, W]
        columns, rows = (
            np.stack([axis + shift for shift in shifts])  # [4, H, W]
            for axis, shifts in zip((columns, rows), _SUBPIXELS, strict=True)
        )
        rays = [
            self._rays(pose, columns[:, edge], rows[:, edge]) for pose, edge in zip(poses, edges, strict=True)
        ]
        for image, edge, samples in zip(images, edges, self._traced(rays), strict=True):
            image[:, edge] = samples.reshape(3, len(_SUBPIXELS[0]), -1).mean(axis=1)
        return np.asarray(np.rint(255 * images.transpose(0, 2, 3, 1)), dtype=np.uint8)

    def _traced(self, rays: list[tuple[Floats, Floats]]) -> list[Floats]:
        """[3, M] sRGB colours of the rays of each camera."""
        colors, _ = trace(self.world, *(np.concatenate(parts, axis=1) for parts in zip(*rays, strict=True)))
        return np.split(colors, np.cumsum([origins.shape[1] for origins, _ in rays])[:-1], axis=1)

    def _rays(
        self, pose: NDArray[np.float64], columns: NDArray[np.floating], rows: NDArray[np.floating]
    ) -> tuple[Floats, Floats]:
        """([3, M] origins, [3, M] unit directions) through image points in pixels."""
        x, y = columns.ravel() - self.width / 2, self.height / 2 - rows.ravel()
        in_camera = np.stack([x / self.focal, y / self.focal, np.full(x.size, -1.0)])
        in_camera /= np.linalg.norm(in_camera, axis=0)
        axes = pose[:3, :3]
        # Spelled out because the last digits of a matrix product depend on the number of threads.
        directions = axes[:, :1] * in_camera[0] + axes[:, 1:2] * in_camera[1] + axes[:, 2:] * in_camera[2]
        origins = np.repeat(pose[:3, 3:], x.size, axis=1)
        return origins.astype(np.float32), directions.astype(np.float32)

    def points(self, images: NDArray[np.uint8], rng: np.random.Generator) -> bytes:
        """A point cloud PLY of what random pixels show, a little off like a reconstruction."""
        views = len(self.poses)
        vertices = np.empty(_POINTS, dtype=[("xyz", "<f4", 3), ("rgb", "u1", 3)])
        for view, pose in enumerate(self.poses):
            count = len(range(view, _POINTS, views))
            rows, columns = rng.integers(0, self.height, count), rng.integers(0, self.width, count)
            origins, directions = self._rays(pose, columns + 0.5, rows + 0.5)
            _, points = trace(self.world, origins, directions)
            distances = np.linalg.norm(points - origins, axis=0)
            points = points + _POINT_NOISE * distances * rng.normal(size=points.shape)
            vertices["xyz"][view::views] = points.T
            vertices["rgb"][view::views] = images[view, rows, columns]
        properties = [*(f"float {axis}" for axis in "xyz"), *(f"uchar {name}" for name in _COLORS)]
        return ply_header({"vertex": (_POINTS, properties)}) + vertices.tobytes()

    def transforms(self, names: list[str]) -> bytes:
        """The cameras as JSON, each with the name of its photo."""
        lens = {"camera_model": "PINHOLE", "w": self.width, "h": self.height}
        lens |= {"fl_x": self.focal, "fl_y": self.focal, "cx": self.width / 2, "cy": self.height / 2}
        frames = [
            {"file_path": name, "transform_matrix": pose.tolist()}
            for name, pose in zip(names, self.poses, strict=True)
        ]
        text = json.dumps({**lens, "ply_file_path": "points.ply", "frames": frames}, indent=1)
        return f"{text}\n".encode()
