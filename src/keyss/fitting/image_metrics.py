"""Image quality: PSNR, SSIM and LPIPS of renders against photos."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean

import torch
from torch import Tensor

from keyss.core.errors import KeyssError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import View
from keyss.fitting.losses import Target, ssim
from keyss.fitting.lpips import lpips_alex
from keyss.rendering import render


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
