"""Cameras around a model: renders that replace photos, and the difference between renders of two models."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor

from keyss.core.errors import UsageError
from keyss.core.gaussians import SH_C0, Gaussians
from keyss.core.scene import NEAR, ORDINARY_EXTENT, Camera, Scene, View, checked_background
from keyss.files.models import is_model_source
from keyss.kernels.memory import release
from keyss.rendering.rasterize import MAX_SIDE
from keyss.rendering.view import render

VIEWS = 96
IMAGE_SIZE = 400  # pixels, width and height
FIELD_OF_VIEW = 50.0  # degrees
MAX_ELEVATION = 60.0  # degrees, up and down
# Cycle of camera distances, relative to the one from which the whole model is visible.
DISTANCES = (1.0, 0.75, 1.0, 0.5)
TEST_EVERY, _LARGE = 12, 500_000  # views; minimum Gaussians of a model with slow renders
_QUANTILE, _MAX_RATIO = 0.95, 10.0  # weights are clamped to this multiple of this quantile
_ORBIT_VIEWS, _SCENE_VIEWS, _SIZE = 4, 8, 256  # for comparing models
SAMPLE = 200_000  # maximum Gaussians for computing `middle_and_radius`


def is_model(source: str | Path | Gaussians) -> bool:
    """True if a source is a model or a model's path, not a folder of photos."""
    return isinstance(source, Gaussians) or is_model_source(source)


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
    size = IMAGE_SIZE if size is None else size
    if not 1 <= size <= MAX_SIDE:
        raise UsageError(f"expected a width of 1 to {MAX_SIDE:,} pixels for renders of a model, got {size:,}")
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


def orbit(model: Gaussians, size: int, views: int = VIEWS) -> list[Camera]:
    """Cameras on a spiral over a sphere around a model, with images of size x size pixels.

    All look at the middle of the visible model. Up is -y, as in COLMAP's scenes and in viewers.
    """
    middle, radius = middle_and_radius(model)
    tangent = math.tan(math.radians(FIELD_OF_VIEW / 2))
    K = torch.tensor([[size / 2 / tangent, 0, size / 2], [0, size / 2 / tangent, size / 2], [0, 0, 1]])
    reach = radius / math.sin(math.radians(FIELD_OF_VIEW / 2))
    limit = math.sin(math.radians(MAX_ELEVATION))
    near = NEAR * min(1.0, radius / ORDINARY_EXTENT)
    cameras = []
    for index in range(views):
        # A Fibonacci lattice: equal steps of the sine of the elevation, golden angles of the azimuth.
        height = limit * (1 - 2 * (index + 0.5) / views)
        azimuth = index * math.pi * (3 - math.sqrt(5))
        flat = math.sqrt(1 - height * height)
        outward = torch.tensor([flat * math.cos(azimuth), -height, flat * math.sin(azimuth)])
        pose = look_at(middle + outward * reach * DISTANCES[index % len(DISTANCES)], -outward)
        cameras.append(Camera(pose, K, size, size, f"orbit_{index:03d}.png", near))
    return cameras


def middle_and_radius(model: Gaussians) -> tuple[Tensor, float]:
    """The middle [3] and the radius of the visible part of a model, in world units.

    Gaussians are weighted by opacity and size, clamped to ten times that of a large one. The radius contains
    90 % of the weight, but is at most three times the radius of 50 %: it covers an object, and the middle of
    an unbounded scene. Large models are subsampled.
    """
    model = model[:: max(1, len(model) // SAMPLE)]
    scales = model.scales.sort(dim=1).values
    weight = (model.opacities * scales[:, 1] * scales[:, 2]).cpu().nan_to_num(0.0)
    weight = weight.clamp_max(_MAX_RATIO * _quantile(weight, torch.ones(len(model)), _QUANTILE))
    means = model.means.cpu()
    middle = torch.stack([_quantile(means[:, axis], weight, 0.5) for axis in range(3)])
    distance = (means - middle).norm(dim=1)
    half, nine_tenths = (float(_quantile(distance, weight, share)) for share in (0.5, 0.9))
    return middle, max(min(nine_tenths, 3 * half), 1e-6)


def _quantile(values: Tensor, weight: Tensor, share: float) -> Tensor:
    values, order = values.sort()
    total = weight[order].double().cumsum(0)
    return values[int(torch.searchsorted(total, share * total[-1]).clamp_max(len(values) - 1))]


def look_at(position: Tensor, forward: Tensor) -> Tensor:
    """[4, 4] world to camera, from `position` along the unit vector `forward`, with -y up."""
    up = torch.tensor([0.0, -1.0, 0.0])
    right = torch.linalg.cross(-up, forward)
    right = right / right.norm()
    down = torch.linalg.cross(forward, right)
    viewmat = torch.eye(4)
    viewmat[:3, :3] = torch.stack([right, down, forward])
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
    return any(bool((render(model, each, background) != background).any()) for each in views.cameras)


def _shrink(camera: Camera) -> Camera:
    scale = min(1.0, _SIZE / max(camera.width, camera.height))
    return camera.resized(max(1, round(scale * camera.width)), max(1, round(scale * camera.height)))
