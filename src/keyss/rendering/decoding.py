"""Pictures that a network makes of what was drawn (GS-Hider, Zhang et al. 2024, section 3.3)."""

from __future__ import annotations

from typing import Any

import torch.nn.functional as F
from torch import Tensor

from keyss.core.decoded import PictureNetwork
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Camera
from keyss.rendering.rasterize import rasterization


def decode_picture(drawn: Tensor, network: PictureNetwork) -> Tensor:
    """[H, W, 3] of what was drawn [H, W, C], behind which the network's own background lies."""
    planes = drawn.permute(2, 0, 1)[None]
    for index, (weight, bias) in enumerate(network.layers):
        planes = F.conv2d(planes if index == 0 else planes.relu(), weight, bias, padding=1)
    return planes[0].permute(1, 2, 0).contiguous()


def draw_features(
    gaussians: Gaussians, features: Tensor, camera: Camera, background: Tensor
) -> tuple[Tensor, dict[str, Any]]:
    """What a camera sees of `features` [N, C] before `background` [C]: [H, W, C], and the meta."""
    images, alphas, meta = rasterization(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        features,
        camera.viewmat.to(features.device)[None],
        camera.K.to(features.device)[None],
        camera.width,
        camera.height,
        backgrounds=background.to(features.device)[None],
    )
    return images.squeeze(0), meta | {"alpha": alphas.squeeze(0).squeeze(-1)}
