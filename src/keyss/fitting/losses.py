"""The photometric loss of 3DGS: (1 - lambda) L1 + lambda (1 - SSIM) (3DGS, eq. 7; KeySS, eq. 4 to 6).

SSIM is the 3DGS variant: 11x11 Gaussian window of sigma 1.5, zero padding, mean over all pixels and
channels. The statistics of the target image, which never change, are kept in a `Target`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from keyss.fitting import ssim_cpu

C1, C2 = 0.01**2, 0.03**2


def _blur(planes: Tensor) -> Tensor:
    """SSIM's window over the last two axes of [B, H, W], zeros outside, in torch."""
    window = torch.from_numpy(ssim_cpu.WINDOW).to(planes)
    rows = F.conv2d(planes[:, None], window.view(1, 1, 1, -1), padding=(0, ssim_cpu.RADIUS))
    return F.conv2d(rows, window.view(1, 1, -1, 1), padding=(ssim_cpu.RADIUS, 0))[:, 0]


@dataclass(frozen=True)
class Target:
    """An image to compare with, and its SSIM statistics."""

    image: Tensor  # [H, W, 3] in [0, 1]
    planes: Tensor  # [3, H, W], the same values
    mean: Tensor  # [3, H, W] local mean
    variance: Tensor  # [3, H, W] local variance

    @staticmethod
    def of(image: Tensor) -> Target:
        """The target of an image [H, W, 3], float in [0, 1] or uint8."""
        if image.dtype == torch.uint8:
            image = image.float() / 255
        planes = image.permute(2, 0, 1).contiguous()
        stacked = torch.cat([planes, planes * planes])
        if image.device.type == "cpu":
            blurred = torch.empty_like(stacked)
            ssim_cpu.blur(stacked.numpy(), blurred.numpy())
        else:
            blurred = _blur(stacked)
        mean, square = blurred.chunk(2)
        return Target(image, planes, mean, square - mean * mean)


class _PhotometricCpu(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Target, ssim_weight: float) -> Tensor:
        value, gradient = ssim_cpu.loss_and_gradient(
            image.detach().contiguous().numpy(),
            target.planes.numpy(),
            target.mean.numpy(),
            target.variance.numpy(),
            ssim_weight,
        )
        ctx.save_for_backward(torch.from_numpy(gradient))
        return image.new_tensor(value)

    @staticmethod
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None, None]:
        (gradient,) = ctx.saved_tensors
        return upstream * gradient, None, None


def _photometric_cpu(image: Tensor, target: Target, ssim_weight: float) -> Tensor:
    value: Tensor = _PhotometricCpu.apply(image, target, ssim_weight)  # type: ignore[no-untyped-call]
    return value


def ssim_torch(image: Tensor, target: Target) -> Tensor:
    """`ssim` in plain torch, on any device and in any precision: the readable form of the kernels."""
    planes = image.permute(2, 0, 1)
    mean, square, product = _blur(torch.cat([planes, planes * planes, planes * target.planes])).chunk(3)
    variance = square - mean * mean
    covariance = product - mean * target.mean
    numerator = (2 * mean * target.mean + C1) * (2 * covariance + C2)
    denominator = (mean * mean + target.mean * target.mean + C1) * (variance + target.variance + C2)
    return (numerator / denominator).mean()


def ssim(image: Tensor, target: Target) -> Tensor:
    """Mean structural similarity of `image` [H, W, 3] and the target: a differentiable scalar, at most 1."""
    if image.device.type == "cpu":
        return 1 - _photometric_cpu(image, target, 1.0)
    return ssim_torch(image, target)


def photometric_loss(image: Tensor, target: Target, ssim_weight: float) -> Tensor:
    """(1 - w) L1 + w (1 - SSIM) of `image` [H, W, 3] against the target, w in [0, 1]."""
    if ssim_weight != 0 and image.device.type == "cpu":
        return _photometric_cpu(image, target, ssim_weight)
    loss = (image - target.image).abs().mean()
    if ssim_weight == 0:
        return loss
    return (1 - ssim_weight) * loss + ssim_weight * (1 - ssim(image, target))
