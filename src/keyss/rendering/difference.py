"""How alike the renders of two models are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from keyss.core.gaussians import Gaussians
from keyss.core.scene import Camera, Scene
from keyss.rendering.orbit import orbit
from keyss.rendering.view import render

_AROUND, _OF_A_SCENE, _SIZE = 4, 8, 256


@dataclass(frozen=True)
class Viewpoints:
    """The cameras from which models are compared, and the background."""

    cameras: Sequence[Camera]
    background: Tensor = field(default_factory=lambda: torch.zeros(3))  # [3] in [0, 1]

    @staticmethod
    def around(model: Gaussians) -> Viewpoints:
        """Four views around a model, for when nothing but the model is known."""
        return Viewpoints(orbit(model, _SIZE, _AROUND))

    @staticmethod
    def of(scene: Scene) -> Viewpoints:
        """Up to eight training views of a scene: people look at it from about there."""
        cameras = [view.camera for view in scene.train[:: max(1, -(-len(scene.train) // _OF_A_SCENE))]]
        return Viewpoints([_small(camera) for camera in cameras], scene.background)


@torch.no_grad()
def psnr_between(before: Gaussians, after: Gaussians, viewpoints: Viewpoints | None = None) -> float:
    """PSNR in dB between renders of two models, at most 120; by default seen from around the first."""
    views = viewpoints or Viewpoints.around(before)
    errors = [
        (_picture(before, camera, views) - _picture(after, camera, views)).square().mean()
        for camera in views.cameras
    ]
    return float(-10 * torch.log10(torch.stack(errors).mean().clamp_min(1e-12)))


def _picture(model: Gaussians, camera: Camera, views: Viewpoints) -> Tensor:
    return render(model, camera, views.background.to(model.device)).clamp(0, 1)


def _small(camera: Camera) -> Camera:
    scale = min(1.0, _SIZE / max(camera.width, camera.height))
    return camera.resized(max(1, round(scale * camera.width)), max(1, round(scale * camera.height)))
