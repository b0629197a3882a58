"""Cameras around a model, and the scene that pictures rendered from them make."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from keyss.core.errors import UsageError
from keyss.core.gaussians import SH_C0, Gaussians
from keyss.core.scene import Camera, Scene, View, checked_background
from keyss.files.models import is_model_path
from keyss.rendering.arguments import MAX_SIDE
from keyss.rendering.view import render

VIEWS = 96
IMAGE_SIZE = 400  # pixels of a square picture
FIELD_OF_VIEW = 50.0  # degrees
HIGHEST = 60.0  # degrees of elevation, and of depression
# Distances in turn, in units of that from which the whole model is seen: people look at all of it, then near.
DISTANCES = (1.0, 0.75, 1.0, 0.5)
TEST_EVERY = 12
_LARGE, _MAX = 0.95, 10.0  # a weight's quantile, and what the largest may be of it
_SAMPLE = 200_000  # Gaussians that tell where a model lies


def is_model(source: str | Path | Gaussians) -> bool:
    """Whether a source is a model, or the name of one, and not a folder of photos."""
    return isinstance(source, Gaussians) or is_model_path(source)


@torch.no_grad()
def scene_of_model(
    model: Gaussians,
    name: str,
    *,
    size: int | None = None,
    background: Tensor | Sequence[float] | None = None,
    train_pictures: bool = True,
) -> Scene:
    """Pictures of `model`, size x size, from the cameras of `orbit`; every twelfth is kept for testing.

    Without `train_pictures`, where nothing is trained, only those are rendered; the others are [0, 0, 3].
    Raises UsageError for a `size` or `background` out of range.
    """
    size = IMAGE_SIZE if size is None else size
    if not 1 <= size <= MAX_SIDE:
        raise UsageError(
            f"expected a width of 1 to {MAX_SIDE:,} pixels for pictures of a model, got {size:,}"
        )
    background = torch.zeros(3) if background is None else checked_background(background)
    views = []
    for index, camera in enumerate(orbit(model, size)):
        test = index % TEST_EVERY == 0
        if test or train_pictures:
            drawn = render(model, camera, background.to(model.device)).clamp(0, 1).cpu()
            views.append(View(camera, (drawn * 255).round().to(torch.uint8), drawn if test else None))
        else:
            views.append(View(camera, torch.zeros(0, 0, 3, dtype=torch.uint8)))
    colors = ((model.sh[:, 0] * SH_C0 + 0.5).clamp(0, 1) * 255).round().to(torch.uint8)
    return Scene(
        name,
        train=tuple(view for index, view in enumerate(views) if index % TEST_EVERY),
        test=tuple(views[::TEST_EVERY]),
        points=model.means.cpu(),
        colors=colors.cpu(),
        background=background.cpu(),
    )


def orbit(model: Gaussians, size: int, views: int = VIEWS) -> list[Camera]:
    """Cameras on a spiral over a sphere around a model, with pictures of size x size pixels.

    All look at the middle of what can be seen of the model. Up is -y, as captures made with COLMAP have it
    and as viewers assume.
    """
    middle, radius = middle_and_radius(model)
    focal = 0.5 * size / math.tan(math.radians(FIELD_OF_VIEW / 2))
    K = torch.tensor([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    reach = radius / math.sin(math.radians(FIELD_OF_VIEW / 2))
    limit = math.sin(math.radians(HIGHEST))
    cameras = []
    for index in range(views):
        # Equal steps of the sine of the elevation, golden steps of the azimuth: evenly over the sphere.
        height = limit * (1 - 2 * (index + 0.5) / views)
        azimuth = index * math.pi * (3 - math.sqrt(5))
        flat = math.sqrt(1 - height * height)
        outward = torch.tensor([flat * math.cos(azimuth), -height, flat * math.sin(azimuth)])
        position = middle + outward * reach * DISTANCES[index % len(DISTANCES)]
        cameras.append(looking(position, -outward, K, size, f"orbit_{index:03d}.png"))
    return cameras


def middle_and_radius(model: Gaussians) -> tuple[Tensor, float]:
    """[3] where what can be seen of a model lies, and how far it reaches (world units).

    Gaussians count by opacity and size, a huge one no more than ten typical large ones. The radius holds nine
    tenths of them, but is at most three times that of the nearer half: around an object, that is all of it;
    in an unbounded scene, its middle. Of large models every n-th Gaussian is looked at.
    """
    model = model[:: max(1, len(model) // _SAMPLE)]
    scales = model.scales.sort(dim=1).values
    weight = (model.opacities * scales[:, 1] * scales[:, 2]).cpu().nan_to_num(0.0)
    weight = weight.clamp_max(_MAX * _quantile(weight, torch.ones(len(model)), _LARGE))
    means = model.means.cpu()
    middle = torch.stack([_quantile(means[:, axis], weight, 0.5) for axis in range(3)])
    distance = (means - middle).norm(dim=1)
    half, most = (float(_quantile(distance, weight, share)) for share in (0.5, 0.9))
    return middle, max(min(most, 3 * half), 1e-6)


def _quantile(values: Tensor, weight: Tensor, share: float) -> Tensor:
    values, order = values.sort()
    total = weight[order].double().cumsum(0)
    return values[int(torch.searchsorted(total, share * total[-1]).clamp_max(len(values) - 1))]


def looking(position: Tensor, forward: Tensor, K: Tensor, size: int, name: str) -> Camera:
    """A camera at `position` that looks along the unit vector `forward`, with -y up."""
    return Camera(look_at(position, forward, torch.tensor([0.0, -1.0, 0.0])), K, size, size, name)


def look_at(position: Tensor, forward: Tensor, up: Tensor) -> Tensor:
    """[4, 4] world to camera, from `position` along the unit vector `forward`, which is not that of `up`."""
    right = torch.linalg.cross(-up, forward)
    right = right / right.norm()
    down = torch.linalg.cross(forward, right)
    viewmat = torch.eye(4, dtype=position.dtype)
    viewmat[:3, :3] = torch.stack([right, down, forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ position
    return viewmat
