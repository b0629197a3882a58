"""Render `Gaussians` from a `Camera`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from keyss.core import Camera, Gaussians
from keyss.core.picture_network import DecodedGaussians, PictureNetwork
from keyss.rendering.rasterize import rasterization


def render(
    gaussians: Gaussians, camera: Camera, background: Tensor | None = None, *, sh_degree: int | None = None
) -> Tensor:
    """Render an image [H, W, 3]: 0 is black, 1 is white, not clamped above.

    `background` [3]: black if None; a model that a network decodes has its own. `sh_degree`: maximum degree
    of the spherical harmonics, by default all. Renders on the device of the Gaussians; differentiable. Raises
    the errors of `rasterization`.
    """
    return render_with_meta(gaussians, camera, background, sh_degree=sh_degree)[0]


def render_with_meta(
    gaussians: Gaussians, camera: Camera, background: Tensor | None = None, *, sh_degree: int | None = None
) -> tuple[Tensor, dict[str, Any]]:
    """`render`, and the meta of `rasterization` with the `alpha` [H, W]."""
    if sh_degree is None:
        sh_degree = gaussians.sh_degree
    if not isinstance(gaussians, DecodedGaussians):
        return _render(gaussians, gaussians.sh, camera, background, sh_degree)
    network, colors = gaussians.network, gaussians.sh
    if gaussians.features is not None:
        colors, sh_degree = gaussians.features, None
    image, meta = _render(gaussians, colors, camera, network.background, sh_degree)
    return decode_picture(image, network), meta


def render_features(
    gaussians: Gaussians, features: Tensor, camera: Camera, background: Tensor | None = None
) -> tuple[Tensor, dict[str, Any]]:
    """`render_with_meta` with `features` [N, C] instead of colours; the image is [H, W, C]."""
    return _render(gaussians, features, camera, background, None)


def decode_picture(features: Tensor, network: PictureNetwork) -> Tensor:
    """Decode an image [H, W, 3] from rendered features [H, W, C] (GS-Hider, Zhang et al. 2024, 3.3)."""
    planes = features.permute(2, 0, 1)[None]
    for index, (weight, bias) in enumerate(network.layers):
        planes = F.conv2d(planes if index == 0 else planes.relu(), weight, bias, padding=1)
    return planes[0].permute(1, 2, 0).contiguous()


@torch.enable_grad()
def contributions(gaussians: Gaussians, cameras: Sequence[Camera]) -> Tensor:
    """[N] blending weights of each Gaussian, summed over all pixels of all views."""
    model = gaussians.detach()
    # An image is linear in the colours: the gradient with respect to a colour is the sum of its weights.
    grey = torch.zeros(len(model), 1, device=model.device, requires_grad=True)
    total = torch.zeros(len(model), device=model.device)
    for camera in cameras:
        image, _ = render_features(model, grey, camera)
        total += torch.autograd.grad(image.sum(), grey)[0][:, 0]
    return total


def _render(
    gaussians: Gaussians, colors: Tensor, camera: Camera, background: Tensor | None, sh_degree: int | None
) -> tuple[Tensor, dict[str, Any]]:
    device = gaussians.device
    image, alpha, meta = rasterization(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        colors,
        camera.viewmat.to(device),
        camera.K.to(device),
        camera.width,
        camera.height,
        near_plane=camera.near,
        sh_degree=sh_degree,
        background=None if background is None else background.to(device),
    )
    return image, meta | {"alpha": alpha}
