"""Similarity of images to photos, after the best fit of colours."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass
from statistics import fmean

import torch
import torch.nn.functional as F
from torch import Tensor

from keyss.core.gaussians import Gaussians
from keyss.core.scene import View
from keyss.fitting.image_metrics import view_quality
from keyss.rendering import render

# Limits of a leak, in scores that respond to the secret's shapes and not to haze.
PSNR_LIMIT = 1.0  # dB closer to the secret's photos than a control
SSIM_LIMIT = 0.05
GRADIENT_LIMIT = 0.1  # correlation of coarse gradients with the photos', above a control's

COARSE = 64  # pixels of the longer side: shapes that are slightly misplaced still match


@dataclass(frozen=True)
class LeakScores:
    """How well images show photos: means over views, or differences of such means.

    PSNR and SSIM after the best fit of colours. Without it any bright cloud is closer to a photo than black.
    """

    psnr_fitted: float  # dB
    ssim_fitted: float  # as in 3DGS
    gradient: float  # `gradient_correlation`
    gradient_coarse: float  # the same of `coarse` images

    @staticmethod
    def combined(function: Callable[[Sequence[float]], float], rows: Sequence[LeakScores]) -> LeakScores:
        """A function of each score over all rows."""
        return LeakScores(*(function(column) for column in zip(*map(astuple, rows), strict=True)))

    def evidence(self) -> float:
        """The maximum of a leak's scores relative to their limits; above 1 the secret's shapes show.

        Of those that haze alone does not increase.
        """
        return max(
            self.psnr_fitted / PSNR_LIMIT,
            self.ssim_fitted / SSIM_LIMIT,
            self.gradient_coarse / GRADIENT_LIMIT,
        )

    def __sub__(self, other: LeakScores) -> LeakScores:
        return LeakScores(*(a - b for a, b in zip(astuple(self), astuple(other), strict=True)))


def gradient_correlation(image: Tensor, reference: Tensor) -> float:
    """Normalised cross-correlation of the brightness gradients of two [H, W, 3] images, -1 to 1.

    Of central differences of the mean channel: the sum of g . h over inner pixels, divided by the root of the
    product of the sums of |g|^2 and |h|^2. Invariant to brightness and contrast; 1 for equal images, -1 for
    the negative, 0 for a constant image.
    """
    first, second = _gradients(image), _gradients(reference)
    size = (first.square().sum() * second.square().sum()).sqrt()
    return float((first * second).sum() / size) if size > 0 else 0.0


def coarse(image: Tensor) -> Tensor:
    """[h, w, 3] the image shrunk to COARSE pixels on its longer side by averaging; never enlarged."""
    height, width = image.shape[:2]
    scale = min(1.0, COARSE / max(height, width))
    size = (max(1, round(scale * height)), max(1, round(scale * width)))
    return F.adaptive_avg_pool2d(image.permute(2, 0, 1), size).permute(1, 2, 0)


def fit_colours(image: Tensor, reference: Tensor) -> Tensor:
    """[H, W, 3] the image with the factor, of either sign, and offset per channel that fit best.

    Least squares. A constant channel becomes the mean of the reference's.
    """
    centred, target = image - image.mean(dim=(0, 1)), reference - reference.mean(dim=(0, 1))
    variance = centred.square().sum(dim=(0, 1))
    factor = (centred * target).sum(dim=(0, 1)) / variance.clamp_min(1e-12)
    return centred * factor + reference.mean(dim=(0, 1))


@torch.no_grad()
def leak_scores(model: Gaussians, views: Sequence[View], background: Tensor) -> LeakScores:
    """Scores of a model against the photos of views, means over the views."""
    rows = []
    for view in views:
        photo = view.image.to(model.device).float() / 255
        image = render(model, view.camera, background).clamp(0, 1)
        fitted = view_quality(fit_colours(image, photo).clamp(0, 1), photo)
        gradient = gradient_correlation(image, photo)
        gradient_coarse = gradient_correlation(coarse(image), coarse(photo))
        rows.append(LeakScores(fitted.psnr, fitted.ssim, gradient, gradient_coarse))
    return LeakScores.combined(fmean, rows)


def _gradients(image: Tensor) -> Tensor:
    """[2, H - 2, W - 2] central differences of the brightness, down and to the right."""
    grey = image.double().mean(dim=2)
    down, right = grey[2:, 1:-1] - grey[:-2, 1:-1], grey[1:-1, 2:] - grey[1:-1, :-2]
    return torch.stack([down, right])
