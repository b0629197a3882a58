"""How much two models differ in pictures."""

from __future__ import annotations

import torch

from keyss.core.gaussians import Gaussians
from keyss.rendering.orbit import orbit
from keyss.rendering.view import render

_VIEWS, _SIZE = 4, 256


@torch.no_grad()
def cost(before: Gaussians, after: Gaussians) -> float:
    """PSNR in dB of views around a model, between before and after; at most 120."""
    cameras = orbit(before, _SIZE, _VIEWS)
    error = torch.stack(
        [
            (render(before, camera).clamp(0, 1) - render(after, camera).clamp(0, 1)).square().mean()
            for camera in cameras
        ]
    )
    return float(-10 * torch.log10(error.mean().clamp_min(1e-12)))
