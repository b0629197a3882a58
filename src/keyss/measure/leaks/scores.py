"""How much of a photo a picture shows, also to somebody who may set exposure and colours as he likes."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from keyss.core.gaussians import Gaussians
from keyss.core.scene import View
from keyss.fitting.image_metrics import psnr
from keyss.fitting.losses import Target, ssim
from keyss.rendering import render

SCORES = ("psnr", "ssim", "gradient", "psnr_fitted", "ssim_fitted")


def gradient_correlation(image: Tensor, reference: Tensor) -> float:
    """Normalised cross-correlation of the brightness gradients of two [H, W, 3] images, -1 to 1.

    Central differences of the mean of the channels; sum of g . h over the pixels within, divided by the root
    of the product of the sums of |g|^2 and |h|^2. Blind to brightness and contrast; 1 for an image itself,
    -1 for its negative, 0 for one that is constant.
    """
    first, second = _gradients(image), _gradients(reference)
    size = (first.square().sum() * second.square().sum()).sqrt()
    return float((first * second).sum() / size) if size > 0 else 0.0


def fit_colours(image: Tensor, reference: Tensor) -> Tensor:
    """[H, W, 3] an image with the best exposure: a factor, of either sign, and an offset for each channel.

    Least squares. A channel that is constant becomes the mean of the reference's.
    """
    centred, target = image - image.mean(dim=(0, 1)), reference - reference.mean(dim=(0, 1))
    variance = centred.square().sum(dim=(0, 1))
    factor = (centred * target).sum(dim=(0, 1)) / variance.clamp_min(1e-12)
    return centred * factor + reference.mean(dim=(0, 1))


@torch.no_grad()
def scores(model: Gaussians, views: Sequence[View], background: Tensor) -> dict[str, float]:
    """How well a model shows the views' photos: means over the views of SCORES.

    PSNR in dB, SSIM as in 3DGS, `gradient_correlation`, and the first two after `fit_colours`. Without the
    fit a light cloud shows more of any photo than black does.
    """
    rows = []
    for view in views:
        photo = view.image.to(model.device).float() / 255
        image = render(model, view.camera, background).clamp(0, 1)
        fitted, target = fit_colours(image, photo).clamp(0, 1), Target.of(photo)
        rows.append(
            (
                psnr(image, photo),
                float(ssim(image, target)),
                gradient_correlation(image, photo),
                psnr(fitted, photo),
                float(ssim(fitted, target)),
            )
        )
    return {
        name: sum(column) / len(rows) for name, column in zip(SCORES, zip(*rows, strict=True), strict=True)
    }


def _gradients(image: Tensor) -> Tensor:
    """[2, H - 2, W - 2] central differences of the brightness, down and to the right."""
    grey = image.double().mean(dim=2)
    down, right = grey[2:, 1:-1] - grey[:-2, 1:-1], grey[1:-1, 2:] - grey[1:-1, :-2]
    return torch.stack([down, right])
