"""Which Gaussians a view may show, and how much each adds to what views show."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from keyss.core.gaussians import Gaussians
from keyss.core.scene import Camera
from keyss.rendering import rasterization


@torch.no_grad()
def possibly_seen(gaussians: Gaussians, camera: Camera, slack: float) -> Tensor:
    """Indices of the Gaussians that may touch the view once decoded: only they are worth decoding.

    A Gaussian is left out when a ball of 3 standard deviations around it, widened by `slack` (world units, by
    what the decoder may move it), lies outside the frustum, widened by a tenth.
    """
    viewmat, intrinsics = camera.viewmat.to(gaussians.device), camera.K
    x, y, z = (gaussians.means @ viewmat[:3, :3].T + viewmat[:3, 3]).unbind(1)
    radius = 3 * gaussians.scales.amax(1) + slack
    depth = z + radius
    fx, fy, cx, cy = (float(intrinsics[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    half_width = max(cx, camera.width - cx) / fx
    half_height = max(cy, camera.height - cy) / fy
    seen = (
        (depth > 0.01)
        & (x.abs() - radius < 1.1 * half_width * depth)
        & (y.abs() - radius < 1.1 * half_height * depth)
    )
    return seen.nonzero()[:, 0]


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
