"""PSNR, SSIM in two variants and LPIPS of images against references of the same views."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, replace
from functools import partial
from statistics import fmean
from typing import Any

import numpy as np
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor

from keyss.core import Gaussians, InputError, KeyssError, Scene, View
from keyss.core.arrays import Bytes, Doubles, Flags
from keyss.files.images import png_names
from keyss.fitting.image_metrics import psnr, subsample_views
from keyss.fitting.lpips import lpips_alex
from keyss.rendering import render

Images = Sequence[tuple[str, Tensor | Bytes]]  # names and uint8 [H, W, 3]

STEGANALYSED_VIEWS = 64
RADIUS = 5  # SSIM's 11 x 11 window


@dataclass(frozen=True)
class ImageScores:
    """Scores of an image against its reference. SSIM: 11 x 11 Gaussian window of sigma 1.5, mean over RGB."""

    psnr: float  # dB; at most 120, for equal images
    ssim_3dgs: float  # 3DGS's, with zero padding
    ssim_standard: float  # crops a border of 5 pixels (Wang et al. 2004, scikit-image, pytorch-msssim)
    lpips_alex: float | None = None  # LPIPS 0.1 with AlexNet, from 0; needs at least 31 x 31 pixels


@dataclass(frozen=True)
class ImageComparison:
    """Images against references of the same names."""

    views: dict[str, ImageScores]  # scores by view name
    mean: ImageScores  # over the views (Mip-NeRF 360's protocol for PSNR)
    missing: str | None = None  # why there is no LPIPS


def compare_images(
    reference: Images, other: Images, masks: Mapping[str, Tensor] | None = None
) -> ImageComparison:
    """Scores of images against references of the same names, in the form that `keyss.render` returns.

    `masks`, by name, are [H, W] bool, True where an image counts; LPIPS takes the others as equal.
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
        mask = (masks or {}).get(name, torch.ones(a.shape[:2], dtype=torch.bool))
        a, b = (torch.where(mask[:, :, None], each, a[mask].mean(0)) for each in (a, b))
        scores = ImageScores(psnr(a, b, mask), *_ssim(a.numpy(), b.numpy(), mask.numpy()))
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


def _ssim(a: Doubles, b: Doubles, mask: Flags) -> tuple[float, float]:
    """SSIM with zero padding, and without the border."""
    blur = partial(gaussian_filter, sigma=1.5, mode="constant", radius=RADIUS, axes=(0, 1))
    c1, c2 = 0.01**2, 0.03**2
    mean_a, mean_b = blur(a), blur(b)
    variances = blur(a * a) - mean_a**2 + blur(b * b) - mean_b**2
    covariance = blur(a * b) - mean_a * mean_b
    numerator = (2 * mean_a * mean_b + c1) * (2 * covariance + c2)
    values = numerator / ((mean_a**2 + mean_b**2 + c1) * (variances + c2))
    inner = slice(RADIUS, -RADIUS), slice(RADIUS, -RADIUS)
    return float(values[mask].mean()), float(values[inner][mask[inner]].mean())


def select_views(views: Sequence[View]) -> list[View]:
    """At most 64 views, evenly spaced in the order of their names."""
    return list(subsample_views(sorted(views, key=lambda view: view.camera.name), STEGANALYSED_VIEWS))


def photos_of(views: Sequence[View]) -> list[tuple[str, Tensor]]:
    """Names and uint8 photos [H, W, 3] of views, in the form of `renders_of`."""
    names = png_names(view.camera for view in views)
    return [(name, view.image) for name, view in zip(names, views, strict=True)]


def masks_of(views: Sequence[View]) -> dict[str, Tensor]:
    """The masks of views that have one, by the names of `photos_of`."""
    named = zip(png_names(view.camera for view in views), views, strict=True)
    return {name: view.mask for name, view in named if view.mask is not None}


@torch.no_grad()
def renders_of(model: Gaussians, scene: Scene, views: Sequence[View]) -> list[tuple[str, Tensor]]:
    """Names and uint8 renders [H, W, 3], on the CPU, of a model from the cameras of a scene's views."""
    background, renders = scene.background.to(model.device), []
    names = png_names(view.camera for view in views)
    for name, view in zip(names, views, strict=True):
        image = render(model, view.camera, background).clamp(0, 1)
        renders.append((name, (image * 255).round().to(torch.uint8).cpu()))
    return renders
