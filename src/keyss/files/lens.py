"""Camera lenses of photos, and undistortion to pinhole cameras.

Pixel centres are at half-integers, as in COLMAP and Nerfstudio: the middle of an image is
(width / 2, height / 2). OpenCV has them at integers, half a pixel less.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from keyss.core.arrays import Bytes, Doubles, Floats
from keyss.core.errors import InputError

MAX_SIDE = 32_000  # pixels; OpenCV's remap addresses sources with signed 16-bit integers
_MAX_ZOOM = 8.0
_BROWN = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")  # OpenCV's order, and that of COLMAP's FULL_OPENCV
_FISHEYE = ("k1", "k2", "k3", "k4")


@dataclass(frozen=True)
class Lens:
    """Intrinsics of a photo: focal lengths and principal point in pixels, and its distortion."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()  # k1 k2 p1 p2 k3 k4 k5 k6 (rational Brown), or fisheye k1 k2 k3 k4
    fisheye: bool = False  # equidistant projection, with or without coefficients

    @property
    def is_pinhole(self) -> bool:
        return not self.fisheye and not any(self.distortion)

    @property
    def K(self) -> Doubles:
        """[3, 3] pixels."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], dtype=np.float64)

    def scale_to(self, width: int, height: int) -> Lens | None:
        """The lens scaled to an image of the same aspect, to within a pixel; None for another aspect.

        Photos are often downscaled (`images_4`) after calibration, each side rounded up or down.
        """
        if (width, height) == (self.width, self.height):
            return self
        factor = max(1, round(self.width / width))
        divided = abs(width * factor - self.width) < factor and abs(height * factor - self.height) < factor
        off = self.height * width / self.width - height, self.width * height / self.height - width
        if not divided and min(map(abs, off)) >= 1:
            return None
        x, y = width / self.width, height / self.height
        return replace(
            self, width=width, height=height, fx=self.fx * x, fy=self.fy * y, cx=self.cx * x, cy=self.cy * y
        )


def make_lens(
    where: str, width: int, height: int, parameters: Mapping[str, float], *, fisheye: bool = False
) -> Lens:
    """A lens from parameters by name: `f` or `fx` and `fy`, `cx`, `cy`, `k1` ... `k6`, `p1`, `p2`.

    Raises InputError, which starts with `where`, if a value is out of range.
    """
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
        raise InputError(
            f"{where}: expected an image size of 1 to {MAX_SIDE} pixels, found {width:g}x{height:g}"
        )
    values = dict(parameters)
    focal = values.pop("f", math.nan)
    fx, fy = values.pop("fx", focal), values.pop("fy", focal)
    cx, cy = values.pop("cx"), values.pop("cy")
    if not (1e-3 <= fx <= 1e7 and 1e-3 <= fy <= 1e7):
        raise InputError(
            f"{where}: expected focal lengths of 0.001 to 10,000,000 pixels, found {fx:g}, {fy:g}"
        )
    if not (abs(cx) <= 1e6 and abs(cy) <= 1e6):
        raise InputError(f"{where}: expected a principal point in or near the image, found ({cx:g}, {cy:g})")
    wild = [f"{name}={value:g}" for name, value in values.items() if not abs(value) <= 100]
    if wild:
        raise InputError(f"{where}: expected distortion coefficients within +-100, found {', '.join(wild)}")
    order = _FISHEYE if fisheye else _BROWN
    distortion = tuple(values.pop(name, 0.0) for name in order)
    if any(values.values()):
        raise InputError(f"{where}: a fisheye lens has no coefficients {', '.join(values)}")
    return Lens(width, height, fx, fy, cx, cy, distortion if any(distortion) or fisheye else (), fisheye)


@dataclass(frozen=True)
class Undistortion:
    """Resamples photos of a distorted lens to a pinhole lens of the same size."""

    pinhole: Lens
    map_x: Floats  # [H, W] OpenCV column in the distorted photo
    map_y: Floats  # [H, W] OpenCV row

    def __call__(self, image: Bytes) -> Bytes:
        """[H, W, ...] undistorted, sampled bilinearly."""
        import cv2  # slow to import, and models do not need it

        border = cv2.BORDER_REPLICATE
        straight = cv2.remap(image, self.map_x, self.map_y, cv2.INTER_LINEAR, borderMode=border)
        return np.asarray(straight, dtype=np.uint8)


def undistortion(lens: Lens, where: str) -> Undistortion:
    """The resampling from `lens` to a pinhole lens with the same principal point and size.

    Focal lengths are scaled by the smallest factor from 1 to 8 at which the photo covers every pixel of the
    new image. OpenCV's search would move the principal point and accept content that a lens shows twice.
    Raises InputError, which starts with `where`, if there is no such factor.
    """
    if _covers(lens, 1.0):
        zoom = 1.0
    elif _covers(lens, _MAX_ZOOM):
        too_wide, zoom = 1.0, _MAX_ZOOM
        while zoom - too_wide > 1e-4:
            middle = (too_wide + zoom) / 2
            too_wide, zoom = (too_wide, middle) if _covers(lens, middle) else (middle, zoom)
    else:
        raise InputError(
            f"{where}: the lens distortion {lens.distortion} cannot be undone; "
            "undistort the photos first, for example with `colmap image_undistorter`"
        )
    pinhole = replace(lens, fx=lens.fx * zoom, fy=lens.fy * zoom, distortion=(), fisheye=False)
    return Undistortion(pinhole, *_source_coordinates(lens, _opencv_K(pinhole), (lens.width, lens.height)))


def _opencv_K(lens: Lens) -> Doubles:
    return lens.K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]


def _source_coordinates(lens: Lens, new_K: Doubles, size: tuple[int, int]) -> tuple[Floats, Floats]:
    """Photo coordinates (OpenCV's x and y) of each pixel of a pinhole image with `new_K`."""
    import cv2

    prepare = cv2.fisheye.initUndistortRectifyMap if lens.fisheye else cv2.initUndistortRectifyMap
    maps = prepare(_opencv_K(lens), np.array(lens.distortion), np.eye(3), new_K, size, cv2.CV_32FC1)
    return np.asarray(maps[0], dtype=np.float32), np.asarray(maps[1], dtype=np.float32)


def _covers(lens: Lens, zoom: float) -> bool:
    """True if a pinhole with focal lengths times `zoom` sees only the photo's content, and only once.

    Checks a grid of 128 x 128 cells including the corners. Polynomial distortion folds back far from the
    axis, where it shows content twice and its Jacobian is negative.
    """
    cells = 128
    K = _opencv_K(replace(lens, fx=lens.fx * zoom, fy=lens.fy * zoom))
    K[0] *= cells / max(lens.width - 1, 1)
    K[1] *= cells / max(lens.height - 1, 1)
    x, y = (m.astype(np.float64) for m in _source_coordinates(lens, K, (cells + 1, cells + 1)))
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        return False
    edge = 0.5 + 1e-3
    if min(x.min(), y.min()) < -edge or x.max() > lens.width - 1 + edge or y.max() > lens.height - 1 + edge:
        return False
    across_x, across_y = np.diff(x, axis=1)[:-1], np.diff(y, axis=1)[:-1]
    down_x, down_y = np.diff(x, axis=0)[:, :-1], np.diff(y, axis=0)[:, :-1]
    return bool((across_x * down_y - across_y * down_x > 0).all())
