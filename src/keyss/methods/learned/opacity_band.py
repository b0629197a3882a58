"""Where a secret's Gaussians lie in the stego model: bands of opacity logits too low to be drawn.

Below 1/255 (logit -5.54) a Gaussian is not drawn at all. A secret's Gaussian starts well below, a little
higher the more opaque it will be: its opacity in the cover tells the decoder its opacity in the secret. Every
secret has a band of its own, and bands must not touch.
"""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass

import torch
from torch import Tensor

from keyss.core.gaussians import DRAWN_OPACITY

DRAWN_LOGIT = math.log(DRAWN_OPACITY / (1 - DRAWN_OPACITY))
HIDDEN_LOGIT, HIDDEN_STEP = -8.2, -3.7  # the middle of the first band, and from one band to the next
HIDDEN_SLOPE = 0.25  # of the hidden logit over the shown one
SHOWN_LOGITS = (-4.0, 6.0)
TRANSPARENT_LOGIT = -8.0  # what all others become
_FURTHEST = 40.0


@dataclass(frozen=True)
class OpacityBand:
    """Opacity logits of one secret, ascending: shown between the inner two, transparent outside the outer."""

    outer_low: float
    inner_low: float
    inner_high: float
    outer_high: float

    @staticmethod
    def of_secret(secret: int) -> OpacityBand:
        """The band of the secret with this number, from 0 on."""
        low, high = (_middle(secret) + HIDDEN_SLOPE * logit for logit in SHOWN_LOGITS)
        return OpacityBand(low - 0.5, low - 0.1, high + 0.4, high + 0.5)

    @property
    def outer(self) -> tuple[float, float]:
        """Its ends."""
        return self.outer_low, self.outer_high

    def contains(self, logits: Tensor) -> Tensor:
        """[N] which of the logits [N] lie in the band."""
        return (logits > self.outer_low) & (logits < self.outer_high)


def hidden_logits(logits: Tensor, secret: int) -> Tensor:
    """[N] what the opacity logits [N] of a secret are in the cover."""
    return _middle(secret) + HIDDEN_SLOPE * logits.clamp(*SHOWN_LOGITS)


def opacity_remap(secret: int) -> tuple[list[float], list[float]]:
    """Knots and residuals of the map that undoes `hidden_logits` and makes all others transparent."""
    knots = [-_FURTHEST, *astuple(OpacityBand.of_secret(secret)), _FURTHEST]
    inner = [(knot - _middle(secret)) / HIDDEN_SLOPE for knot in knots[2:4]]
    shown = [TRANSPARENT_LOGIT] * 2 + inner + [TRANSPARENT_LOGIT] * 2
    return knots, [after - before for before, after in zip(knots, shown, strict=True)]


def logit_limits(logits: Tensor, secrets: int) -> tuple[Tensor, Tensor]:
    """[N] least and [N] largest opacity logits that leave each Gaussian to the scene that it starts with.

    A secret's stays where its opacity remap shows it: one that left the band would be transparent in every
    scene, and nothing would encrypt it. One of the cover's stays above all bands.
    """
    low, high = torch.full_like(logits, DRAWN_LOGIT - 0.06), torch.full_like(logits, torch.inf)
    for band in map(OpacityBand.of_secret, range(secrets)):
        own = band.contains(logits)
        low[own], high[own] = band.inner_low, band.inner_high
    return low, high


def _middle(secret: int) -> float:
    return HIDDEN_LOGIT + HIDDEN_STEP * secret
