"""Which Gaussians a view may show once a decoder has moved them."""

from __future__ import annotations

import torch
from torch import Tensor

from keyss.core.gaussians import Gaussians
from keyss.core.scene import Camera


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
