"""Cameras around a model: renders that replace photos, and the difference between renders of two models."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeGuard

import numpy as np
import torch
from torch import Tensor

from keyss.core.arrays import Doubles
from keyss.core.errors import UsageError
from keyss.core.gaussians import SH_C0, Gaussians
from keyss.core.scene import NEAR, ORDINARY_EXTENT, Camera, Scene, View, checked_background
from keyss.files.models import is_model_source
from keyss.kernels.memory import release
from keyss.rendering.framing import Frame, frame_of, quantile
from keyss.rendering.rasterize import MAX_SIDE, render

VIEWS = 96
IMAGE_SIZE = 400  # pixels, width and height
FIELD_OF_VIEW = 50.0  # degrees
MAX_ELEVATION = 60.0  # degrees, up and down
# Cycle of camera distances, relative to the one from which the whole model is visible.
DISTANCES = (1.0, 0.75, 1.0, 0.5)
TURNTABLE, _HEIGHT = 60, 0.25  # views; sine of their elevation
_OUTLIERS, _MARGIN = 0.005, 0.9  # share on either side of a centered subject; part of a view for the subject
TEST_EVERY, _LARGE = 12, 500_000  # views; minimum Gaussians of a model with slow renders
_ORBIT_VIEWS, _SCENE_VIEWS, _SIZE = 4, 8, 256  # views and pixels for comparing models


def is_model(source: str | Path | Scene | Gaussians) -> TypeGuard[str | Path | Gaussians]:
    """True if a source is a model or a model's path, not photos."""
    return isinstance(source, Gaussians) or (not isinstance(source, Scene) and is_model_source(source))


@torch.no_grad()
def scene_of_model(
    model: Gaussians,
    name: str,
    *,
    size: int | None = None,
    background: Tensor | Sequence[float] | None = None,
    train_pictures: bool = True,
) -> Scene:
    """A scene of renders of `model`, size x size, from the cameras of `orbit`.

    Every twelfth is a test view; models of 500,000 Gaussians or more have two test views. Without
    `train_pictures`, only test views are rendered; other images are [0, 0, 3]. Raises UsageError for a `size`
    or `background` out of range.
    """
    size = checked_size(size)
    background = torch.zeros(3) if background is None else checked_background(background)
    views, every = [], TEST_EVERY if len(model) < _LARGE else VIEWS // 2
    for index, camera in enumerate(orbit(model, size)):
        test = index % every == 0
        if test or train_pictures:
            image = render(model, camera, background.to(model.device)).clamp(0, 1).cpu()
            views.append(View(camera, (image * 255).round().to(torch.uint8), image if test else None))
        else:
            views.append(View(camera, torch.zeros(0, 0, 3, dtype=torch.uint8)))
    release()
    colors = ((model.sh[:, 0] * SH_C0 + 0.5).clamp(0, 1) * 255).round().to(torch.uint8)
    return Scene(
        name,
        train=tuple(view for index, view in enumerate(views) if index % every),
        test=tuple(views[::every]),
        points=model.means.cpu(),
        colors=colors.cpu(),
        background=background.cpu(),
    )


def from_above(scene: Scene) -> Scene:
    """A scene of renders of a model with only those test views that look down."""
    return replace(scene, test=scene.test[: -(-len(scene.test) // 2)])


def checked_size(size: int | None) -> int:
    """The width and height of renders of a model in pixels. Raises UsageError."""
    size = IMAGE_SIZE if size is None else size
    if not 1 <= size <= MAX_SIDE:
        raise UsageError(f"expected a width of 1 to {MAX_SIDE:,} pixels for renders of a model, got {size:,}")
    return size


def orbit(model: Gaussians, size: int, views: int = VIEWS) -> list[Camera]:
    """Cameras on a spiral over a sphere around the subject of a model, with images of size x size pixels."""
    frame = frame_of(model)
    limit = math.sin(math.radians(MAX_ELEVATION))
    cameras = []
    for index in range(views):
        # A Fibonacci lattice: equal steps of the sine of the elevation, golden angles of the azimuth.
        height = limit * (1 - 2 * (index + 0.5) / views)
        outward = _outward(frame.up, height, index * math.pi * (3 - math.sqrt(5)))
        distance = _far(frame) * DISTANCES[index % len(DISTANCES)]
        cameras.append(_camera(frame, frame.middle, outward, distance, size, f"orbit_{index:03d}.png"))
    return cameras


def turntable(model: Gaussians, size: int, views: int = TURNTABLE) -> list[Camera]:
    """Cameras on a level circle a little above the subject of a model, with images of size x size pixels.

    A subject without surroundings is centered, and whole in every view.
    """
    frame = frame_of(model)
    outwards = [_outward(frame.up, _HEIGHT, 2 * math.pi * index / views) for index in range(views)]
    middle, distance = _whole(frame, outwards) if frame.alone else (frame.middle, _far(frame))
    return [
        _camera(frame, middle, outward, distance, size, f"{index:03d}.png")
        for index, outward in enumerate(outwards)
    ]


def _whole(frame: Frame, outwards: Sequence[Doubles]) -> tuple[Doubles, float]:
    """The center of a subject, and the least distance from which it is whole in each of these directions."""
    basis = np.stack([*_sides(frame.up), frame.up])
    low, high = (
        np.array([quantile(axis, frame.weights, share) for axis in basis @ frame.means.T])
        for share in (_OUTLIERS, 1 - _OUTLIERS)
    )
    middle: Doubles = (low + high) / 2 @ basis
    offsets, half = frame.means - middle, _MARGIN * math.tan(math.radians(FIELD_OF_VIEW / 2))
    distance = 1e-6
    for outward in outwards:
        right = np.cross(frame.up, outward) / np.linalg.norm(np.cross(frame.up, outward))
        aside = np.maximum(abs(offsets @ right), abs(offsets @ np.cross(outward, right)))
        distance = max(distance, float((aside / half + offsets @ outward).max()))
    return middle, distance


def _far(frame: Frame) -> float:
    """The distance at which the sphere fills an image."""
    return frame.radius / math.sin(math.radians(FIELD_OF_VIEW / 2))


def _sides(up: Doubles) -> Doubles:
    """[2, 3] level unit vectors: towards the front, -z, or -y where z is up, and a quarter turn from it."""
    front = np.array([0.0, 0.0, -1.0] if abs(up[1]) > 0.5 else [0.0, -1.0, 0.0])
    level = front - (front @ up) * up
    level /= np.linalg.norm(level)
    return np.stack([level, np.cross(up, level)])


def _outward(up: Doubles, height: float, azimuth: float) -> Doubles:
    """[3] the unit vector at an azimuth from the front; `height`: sine of its elevation."""
    around = np.array([math.cos(azimuth), math.sin(azimuth)]) @ _sides(up)
    outward: Doubles = math.sqrt(1 - height * height) * around + height * up
    return outward


def _camera(frame: Frame, middle: Doubles, outward: Doubles, distance: float, size: int, name: str) -> Camera:
    """A camera at a distance from `middle`, at which it looks."""
    focal = size / 2 / math.tan(math.radians(FIELD_OF_VIEW / 2))
    K = torch.tensor([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    near = NEAR * min(1.0, frame.radius / ORDINARY_EXTENT)
    vectors = middle + distance * outward, -outward, frame.up
    viewmat = look_at(*(torch.from_numpy(vector).float() for vector in vectors))
    return Camera(viewmat, K, size, size, name, near)


def look_at(position: Tensor, forward: Tensor, up: Tensor) -> Tensor:
    """[4, 4] world to camera, from `position` along the unit vector `forward`."""
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, up), dim=0)
    viewmat = torch.eye(4)
    viewmat[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ position
    return viewmat


@dataclass(frozen=True)
class Viewpoints:
    """The cameras from which models are compared, and the background."""

    cameras: Sequence[Camera]
    background: Tensor = field(default_factory=lambda: torch.zeros(3))  # [3] in [0, 1]

    @staticmethod
    def around(model: Gaussians) -> Viewpoints:
        """Four views around a model, for models without cameras."""
        return Viewpoints(orbit(model, _SIZE, _ORBIT_VIEWS))

    @staticmethod
    def of(scene: Scene) -> Viewpoints:
        """Up to eight downscaled training views of a scene."""
        views = scene.train[:: max(1, -(-len(scene.train) // _SCENE_VIEWS))]
        return Viewpoints([_shrink(view.camera) for view in views], scene.background)


@torch.no_grad()
def psnr_between(before: Gaussians, after: Gaussians, viewpoints: Viewpoints | None = None) -> float:
    """PSNR in dB between renders of two models, at most 120; by default from views around the first."""
    views = viewpoints or Viewpoints.around(before)
    errors, background = [], views.background.to(before.device)
    for camera in views.cameras:
        one, other = (render(model, camera, background).clamp(0, 1) for model in (before, after))
        errors.append((one - other).square().mean())
    return float(-10 * torch.log10(torch.stack(errors).mean().clamp_min(1e-12)))


@torch.no_grad()
def is_visible(model: Gaussians) -> bool:
    """True if renders around a model show more than the background."""
    views = Viewpoints.around(model)
    background = views.background.to(model.device)
    return any(bool((render(model, camera, background) != background).any()) for camera in views.cameras)


def _shrink(camera: Camera) -> Camera:
    scale = min(1.0, _SIZE / max(camera.width, camera.height))
    return camera.resized(max(1, round(scale * camera.width)), max(1, round(scale * camera.height)))
