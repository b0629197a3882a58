"""How much of a photo a picture shows, also to somebody who may set exposure and colours as he likes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass
from statistics import fmean

import torch
import torch.nn.functional as F
from torch import Tensor

from keyss.core.gaussians import Gaussians
from keyss.core.scene import View
from keyss.fitting.image_metrics import psnr
from keyss.fitting.losses import Target, ssim
from keyss.rendering import render

# What a leak may come to before the secret's shapes show, and not haze: those after the fit of colours.
PSNR_LIMIT = 1.0  # dB nearer to the secret's photos than a control comes
SSIM_LIMIT = 0.05
GRADIENT_LIMIT = 0.1  # correlation of coarse gradients with the photos', above a control's

COARSE = 64  # pixels of the longer side, at which shapes that are slightly out of place still count


@dataclass(frozen=True)
class LeakScores:
    """How well pictures show photos: means over views, or differences of such.

    Without the fit of colours any light cloud is nearer to a photo than black: plain PSNR and SSIM tell that
    something is seen, not that it is the secret.
    """

    psnr: float  # dB
    ssim: float  # as in 3DGS
    gradient: float  # `gradient_correlation`
    gradient_coarse: float  # the same of `coarse` images
    psnr_fitted: float  # after `fit_colours`, dB
    ssim_fitted: float

    @staticmethod
    def combined(function: Callable[[Sequence[float]], float], rows: Sequence[LeakScores]) -> LeakScores:
        """Each score by a function of that of all rows."""
        return LeakScores(*(function(column) for column in zip(*map(astuple, rows), strict=True)))

    def evidence(self) -> float:
        """Of a leak, how much of the limits it takes: above 1 the secret's shapes show.

        The largest share of PSNR and SSIM after the fit of colours, and of the coarse gradients. What haze
        alone makes larger does not count.
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

    Central differences of the mean of the channels; sum of g . h over the pixels within, divided by the root
    of the product of the sums of |g|^2 and |h|^2. Blind to brightness and contrast; 1 for an image itself,
    -1 for its negative, 0 for one that is constant.
    """
    first, second = _gradients(image), _gradients(reference)
    size = (first.square().sum() * second.square().sum()).sqrt()
    return float((first * second).sum() / size) if size > 0 else 0.0


def coarse(image: Tensor) -> Tensor:
    """[h, w, 3] the image shrunk to COARSE pixels on its longer side, each a mean; a small one as it is."""
    height, width = image.shape[:2]
    scale = min(1.0, COARSE / max(height, width))
    size = (max(1, round(scale * height)), max(1, round(scale * width)))
    return F.adaptive_avg_pool2d(image.permute(2, 0, 1), size).permute(1, 2, 0)


def fit_colours(image: Tensor, reference: Tensor) -> Tensor:
    """[H, W, 3] an image with the best exposure: a factor, of either sign, and an offset for each channel.

    Least squares. A channel that is constant becomes the mean of the reference's.
    """
    centred, target = image - image.mean(dim=(0, 1)), reference - reference.mean(dim=(0, 1))
    variance = centred.square().sum(dim=(0, 1))
    factor = (centred * target).sum(dim=(0, 1)) / variance.clamp_min(1e-12)
    return centred * factor + reference.mean(dim=(0, 1))


@torch.no_grad()
def scores(model: Gaussians, views: Sequence[View], background: Tensor) -> LeakScores:
    """How well a model shows the views' photos."""
    rows = []
    for view in views:
        photo = view.image.to(model.device).float() / 255
        image = render(model, view.camera, background).clamp(0, 1)
        fitted, target = fit_colours(image, photo).clamp(0, 1), Target.of(photo)
        rows.append(
            LeakScores(
                psnr(image, photo),
                float(ssim(image, target)),
                gradient_correlation(image, photo),
                gradient_correlation(coarse(image), coarse(photo)),
                psnr(fitted, photo),
                float(ssim(fitted, target)),
            )
        )
    return LeakScores.combined(fmean, rows)


def _gradients(image: Tensor) -> Tensor:
    """[2, H - 2, W - 2] central differences of the brightness, down and to the right."""
    grey = image.double().mean(dim=2)
    down, right = grey[2:, 1:-1] - grey[:-2, 1:-1], grey[1:-1, 2:] - grey[1:-1, :-2]
    return torch.stack([down, right])
