"""What the joint training starts from: the plain models' Gaussians (warm), or sparse points (the paper)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from keyss.core.gaussians import Gaussians
from keyss.fitting.parameters import initial_gaussians, initial_points
from keyss.hiding.config import HideConfig
from keyss.hiding.targets import PlacedScene

# Below 1/255 (logit -5.54) a Gaussian is not drawn at all. A secret's Gaussian starts there, a little
# higher the more opaque it will be: the cover's opacity then tells the decoder the secret's.
HIDDEN_LOGIT = -6.5
HIDDEN_SLOPE = 0.25
SHOWN_LOGITS = (-4.0, 6.0)
TRANSPARENT_LOGIT = -8.0


@dataclass(frozen=True)
class Start:
    """Initial Gaussians of the published model."""

    gaussians: Gaussians
    # For each secret the opacity logits [N] that its key should give at first, or nothing known yet.
    opacity_logits: tuple[Tensor, ...] | None


def make_start(scenes: Sequence[PlacedScene], config: HideConfig, generator: torch.Generator) -> Start:
    """The start for the cover (first of `scenes`) and its secrets."""
    if config.start == "points":
        return _from_points(scenes, config, generator)
    return _from_models(scenes, config)


def _from_points(scenes: Sequence[PlacedScene], config: HideConfig, generator: torch.Generator) -> Start:
    """Combined SfM points: an equal share of the cap for every scene, what one leaves goes to the others."""
    fit = config.fit
    clouds = [initial_points(placed.scene, fit.max_gaussians, generator) for placed in scenes]
    shares = _shares([len(points) for points, _ in clouds], [1.0] * len(clouds), fit.max_gaussians)
    parts = [
        initial_gaussians(points, colors, fit.sh_degree, share, generator)
        for (points, colors), share in zip(clouds, shares, strict=True)
    ]
    return Start(Gaussians.cat(parts), None)


def _from_models(scenes: Sequence[PlacedScene], config: HideConfig) -> Start:
    """The most visible Gaussians of every plain model; those of the secrets transparent in the cover."""
    plains = [placed.plain.with_sh_degree(config.fit.sh_degree) for placed in scenes]
    weights = [1.0] + [config.secret_share] * (len(scenes) - 1)
    shares = _shares([len(plain) for plain in plains], weights, config.fit.max_gaussians)
    chosen = [_most_visible(plain, share) for plain, share in zip(plains, shares, strict=True)]
    parts = chosen[:1] + [
        replace(part, opacity_logits=HIDDEN_LOGIT + HIDDEN_SLOPE * part.opacity_logits.clamp(*SHOWN_LOGITS))
        for part in chosen[1:]
    ]
    opacity_logits = []
    for secret in range(1, len(chosen)):
        logits = [torch.full((len(part),), TRANSPARENT_LOGIT) for part in chosen]
        logits[secret] = chosen[secret].opacity_logits
        opacity_logits.append(torch.cat(logits))
    return Start(Gaussians.cat(parts), tuple(opacity_logits))


def _shares(available: Sequence[int], weights: Sequence[float], total: int) -> list[int]:
    """`total` items divided by `weights`, nowhere more than `available`; what is left over is given on."""
    shares = [0] * len(available)
    while (left := total - sum(shares)) > 0:
        open_ends = [i for i in range(len(available)) if shares[i] < available[i]]
        if not open_ends:
            break
        weight = sum(weights[i] for i in open_ends)
        for i in open_ends:
            fair = max(1, int(left * weights[i] / weight))
            shares[i] += min(fair, available[i] - shares[i], total - sum(shares))
    return shares


def _most_visible(gaussians: Gaussians, count: int) -> Gaussians:
    """The `count` Gaussians with the largest opacity times cross-section, in their order.

    The cross-section counts with its square root, and no more than that of a typical large Gaussian:
    else a few huge faint ones would go before all detail.
    """
    if count >= len(gaussians):
        return gaussians
    cross_section = gaussians.log_scales.sort(dim=1).values[:, 1:].sum(1)  # log of the larger two axes
    size = (cross_section / 2).clamp_max(float((cross_section / 2).quantile(0.9)))
    visibility = gaussians.opacities * size.exp()
    return gaussians[visibility.topk(count).indices.sort().values]
