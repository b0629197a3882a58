"""The difference between renders of two models."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from keyss.core.gaussians import Gaussians
from keyss.core.scene import Camera, Scene
from keyss.rendering.orbit import orbit
from keyss.rendering.view import render

_ORBIT_VIEWS, _SCENE_VIEWS, _SIZE = 4, 8, 256


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
