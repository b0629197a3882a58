"""What somebody sees who turns up the opacities of a model's faint Gaussians and leaves out the others.

Transparent Gaussians may be those of a secret; figures 2 and 6 of the KeySS paper show this attack. Functions
take a model and give what the attacker renders, and change nothing in place.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from keyss.core.gaussians import Gaussians

OPAQUE = 0.99  # as much as one Gaussian covers in 3DGS
_BRIGHTEST = 0.99  # the quantile that rescaling makes OPAQUE, so that no outlier sets the scale


def opaque(model: Gaussians) -> Gaussians:
    """All Gaussians with opacity OPAQUE."""
    logit = math.log(OPAQUE / (1 - OPAQUE))
    return replace(model, opacity_logits=torch.full_like(model.opacity_logits, logit))


def faint(model: Gaussians, below: float) -> Gaussians:
    """The Gaussians with opacities under `below` alone, as they are."""
    return model[model.opacities < below]


def rescaled(model: Gaussians) -> Gaussians:
    """Opacities multiplied by one factor that makes the largest ones OPAQUE."""
    if len(model) == 0:
        return model
    opacities = model.opacity_logits.double().sigmoid()
    top = opacities.sort().values[int(_BRIGHTEST * (len(model) - 1))]
    scaled = (opacities * (OPAQUE / top)).clamp(max=OPAQUE)
    return replace(model, opacity_logits=scaled.logit().to(model.opacity_logits))


def matched(model: Gaussians, below: float) -> Gaussians:
    """The Gaussians with opacities under `below`, with those of the others: the least opaque gets the least.

    It undoes whatever made opacities small without changing their order.
    """
    chosen = model.opacities < below
    part, others = model[chosen], model.opacity_logits[~chosen].sort().values
    if len(part) == 0 or len(others) == 0:
        return part
    ranks = part.opacity_logits.argsort().argsort()
    rows = ((ranks + 0.5) * (len(others) / len(part))).long().clamp(max=len(others) - 1)
    return replace(part, opacity_logits=others[rows])


def inverted(model: Gaussians) -> Gaussians:
    """Opacities o become 1 - o."""
    return replace(model, opacity_logits=-model.opacity_logits)


def least_contributing(model: Gaussians, weights: Tensor, share: float) -> Gaussians:
    """The `share` of the Gaussians that add least to what is seen: `weights` [N] of `contributions`."""
    return model[weights.argsort(stable=True)[: round(share * len(model))]]
