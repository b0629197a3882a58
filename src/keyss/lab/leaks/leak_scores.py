"""Run attacks on a stego model and on plain models, and score the images against the secret's photos."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass
from statistics import fmean

import torch
import torch.nn.functional as F
from torch import Tensor

from keyss.core.arrays import Bytes
from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene, View
from keyss.fitting.image_metrics import psnr, subsample_views
from keyss.fitting.losses import Target, ssim
from keyss.lab.leaks.attacks import Attack
from keyss.rendering import render

# Limits of a leak, in scores that haze alone does not increase.
PSNR_LIMIT = 1.0  # dB closer to the secret's photos than a control
SSIM_LIMIT = 0.05
GRADIENT_LIMIT = 0.1  # correlation of coarse gradients with the photos', above a control's

COARSE = 64  # pixels of the longer side: slightly misplaced shapes still match

_VIEWS = 8  # cameras per scene for attacks


@dataclass(frozen=True)
class LeakScores:
    """Similarity of images to photos: means over views, or differences of such means.

    PSNR and SSIM after `fit_colours`; otherwise any bright haze would be closer to a photo than black.
    """

    psnr_fitted: float  # dB
    ssim_fitted: float  # 3DGS's SSIM
    gradient: float  # `gradient_correlation` of `coarse` images

    @staticmethod
    def combine(function: Callable[[Sequence[float]], float], rows: Sequence[LeakScores]) -> LeakScores:
        """Apply `function` to each score over all rows."""
        return LeakScores(*(function(column) for column in zip(*map(astuple, rows), strict=True)))

    def evidence(self) -> float:
        """The maximum ratio of a leak's scores to their limits; above 1 the secret's shapes are visible."""
        return max(
            self.psnr_fitted / PSNR_LIMIT, self.ssim_fitted / SSIM_LIMIT, self.gradient / GRADIENT_LIMIT
        )

    def __sub__(self, other: LeakScores) -> LeakScores:
        return LeakScores(*(a - b for a, b in zip(astuple(self), astuple(other), strict=True)))


def gradient_correlation(image: Tensor, reference: Tensor) -> float:
    """Normalised cross-correlation of the brightness gradients of two [H, W, 3] images, -1 to 1.

    With central differences g and h of the mean channel: sum(g . h) / sqrt(sum(|g|^2) sum(|h|^2)) over inner
    pixels. Invariant to brightness and contrast; 1 for equal images, -1 for the negative, 0 for a constant
    image.
    """
    first, second = _gradients(image), _gradients(reference)
    size = (first.square().sum() * second.square().sum()).sqrt()
    return float((first * second).sum() / size) if size > 0 else 0.0


def coarse(image: Tensor) -> Tensor:
    """[h, w, 3] the image averaged down to COARSE pixels on its longer side; smaller images do not change."""
    height, width = image.shape[:2]
    scale = min(1.0, COARSE / max(height, width))
    size = (max(1, round(scale * height)), max(1, round(scale * width)))
    return F.adaptive_avg_pool2d(image.permute(2, 0, 1), size).permute(1, 2, 0)


def fit_colours(image: Tensor, reference: Tensor) -> Tensor:
    """[H, W, 3] the image with the least-squares factor (of either sign) and offset per channel.

    A constant channel becomes the mean of the reference's.
    """
    centred, target = image - image.mean(dim=(0, 1)), reference - reference.mean(dim=(0, 1))
    variance = centred.square().sum(dim=(0, 1))
    factor = (centred * target).sum(dim=(0, 1)) / variance.clamp_min(1e-12)
    return centred * factor + reference.mean(dim=(0, 1))


@torch.no_grad()
def leak_scores(model: Gaussians, views: Sequence[View], background: Tensor) -> LeakScores:
    """Mean scores of a model against the photos of views."""
    rows = []
    for view in views:
        photo = view.photo(model.device)
        image = render(model, view.camera, background).clamp(0, 1)
        fitted = fit_colours(image, photo).clamp(0, 1)
        gradient = gradient_correlation(coarse(image), coarse(photo))
        similarity = float(ssim(fitted, Target.of(photo)))
        rows.append(LeakScores(psnr(fitted, photo), similarity, gradient))
    return LeakScores.combine(fmean, rows)


def _gradients(image: Tensor) -> Tensor:
    """[2, H - 2, W - 2] central differences of the brightness, down and to the right."""
    grey = image.double().mean(dim=2)
    down, right = grey[2:, 1:-1] - grey[:-2, 1:-1], grey[1:-1, 2:] - grey[1:-1, :-2]
    return torch.stack([down, right])


@dataclass(frozen=True)
class AttackResult:
    """Scores of an attack on the stego model, and their excess over control models.

    An attack has variants: thresholds, shares, clusters. The best one counts, because an attacker recognises
    it.
    """

    attack: str
    sentence: str
    best: str  # the variant with the maximum `LeakScores.evidence`
    scores: LeakScores  # of the best variant
    leak: LeakScores  # `scores` minus the controls' maxima over the variants


@torch.no_grad()
def look_for_secret(
    stego: Gaussians, controls: Sequence[Gaussians], secret: Scene, attacks: Sequence[Attack]
) -> tuple[list[AttackResult], dict[str, list[Bytes]]]:
    """Score attacks by their renders from the secret's test cameras against its photos.

    This is the strictest assumption: the attacker knows the cameras. `controls` are plain models of the
    cover; `secret` has its test cameras in the cover's frame (`keyss.measure.in_cover`); at most 8 are used.
    Also returns three images, [H, W, 3] uint8, by attack: its best variant on the stego model and on a
    control from the first test camera, and the photo. Raises UsageError without a control or test views.
    """
    if not controls:
        raise UsageError("leaks: expected at least one plain model of the cover to compare with")
    if not secret.test:
        raise UsageError(f"leaks: the scene {secret.name} has no test views")
    views = subsample_views(secret.test, _VIEWS)

    def look(attack: Attack, model: Gaussians) -> dict[str, tuple[LeakScores, Bytes]]:
        """Scores of all variants of an attack, and pictures [H, W, 3] uint8 from the first view."""
        shown = {}
        for label, variant in attack.show(model):
            image = render(variant, views[0].camera, secret.background).clamp(0, 1)
            picture = (image * 255).round().to(torch.uint8).cpu().numpy()
            shown[label] = leak_scores(variant, views, secret.background), picture
        return shown

    results, pictures = [], {}
    for attack in attacks:
        variants = look(attack, stego)
        of_controls = [look(attack, model) for model in controls]
        highest = [LeakScores.combine(max, [scores for scores, _ in shown.values()]) for shown in of_controls]
        control = LeakScores.combine(fmean, highest)
        leaks = {label: score - control for label, (score, _) in variants.items()}
        best = max(leaks, key=lambda label: leaks[label].evidence())
        scores, picture = variants[best]
        results.append(AttackResult(attack.name, attack.sentence, best, scores, leaks[best]))
        pictures[attack.name] = [picture, of_controls[0][best][1], views[0].image.cpu().numpy()]
    return results, pictures
