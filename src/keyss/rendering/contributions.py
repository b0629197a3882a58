"""How much each Gaussian adds to what views show."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from keyss.core.gaussians import Gaussians
from keyss.core.scene import Camera
from keyss.rendering import rasterization


@torch.enable_grad()
def contributions(gaussians: Gaussians, cameras: Sequence[Camera]) -> Tensor:
    """[N] the weights with which each Gaussian is blended, summed over all pixels of all views."""
    model = gaussians.detach()
    # A picture is linear in the colours: its gradient with respect to one is the sum of that one's weights.
    grey = torch.zeros(len(model), 1, device=model.device, requires_grad=True)
    total = torch.zeros(len(model), device=model.device)
    for camera in cameras:
        images, _, _ = rasterization(
            model.means,
            model.quats,
            model.scales,
            model.opacities,
            grey,
            camera.viewmat.to(model.device)[None],
            camera.K.to(model.device)[None],
            camera.width,
            camera.height,
        )
        total += torch.autograd.grad(images.sum(), grey)[0][:, 0]
    return total
