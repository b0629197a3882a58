"""What somebody renders who changes a model to find transparent or unusual Gaussians in it.

Transparent Gaussians may be those of a secret; figures 2 and 6 of the KeySS paper show this attack. And
whatever keeps a second scene in attributes that do not render (lengths of quaternions, harmonics of
transparent Gaussians), or trains it otherwise than the first, may have left a group of its own among them.
Functions change nothing in place.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from keyss.core.gaussians import Gaussians

Attribute = Literal["quaternion length", "scale", "SH energy"]
Side = Literal["low", "high"]

OPAQUE = 0.99  # as much as one Gaussian covers in 3DGS
_BRIGHTEST = 0.99  # the quantile that rescaling makes OPAQUE, so that no outlier sets the scale
_TO_SIGMA = 1.4826  # from a median absolute deviation to the standard deviation of a normal distribution
_LEAST_SPREAD = 1e-3  # of a logarithm: attributes that are equal but for rounding have no outliers
_LEAST_SIZE = 1e-12
_CLUSTER_SAMPLE = 5000  # Gaussians that clusters are found on
_LEAST_CLUSTERED = 10


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


def measured(model: Gaussians, attribute: Attribute) -> Tensor:
    """[N] natural logarithm of the quaternion's length, of the geometric mean of the scales, or of the sum of
    squares of the harmonics above the constant one."""
    if attribute == "scale":
        return model.log_scales.mean(dim=1)
    size = (
        model.quats.norm(dim=1) if attribute == "quaternion length" else model.sh[:, 1:].square().sum((1, 2))
    )
    logarithm: Tensor = size.clamp_min(_LEAST_SIZE).log()
    return logarithm


def outliers(model: Gaussians, attribute: Attribute, side: Side, threshold: float) -> Gaussians:
    """Made opaque, the Gaussians alone whose robust z-score in an attribute is beyond the threshold.

    The score is the distance from the model's own median, in standard deviations as its median absolute
    deviation tells them; on the low side it is negated.
    """
    if len(model) == 0:
        return model
    values = measured(model, attribute)
    middle = values.median()
    spread = _TO_SIGMA * (values - middle).abs().median()
    score = (values - middle) / spread.clamp_min(_LEAST_SPREAD)
    return opaque(model[(score if side == "high" else -score) > threshold])


def clusters(model: Gaussians, count: int, seed: int = 0) -> list[Gaussians]:
    """Made opaque, each of `count` groups of like Gaussians alone, the largest first.

    A mixture of normal distributions of opacity logit, sorted log scales, constant colour, and the logarithms
    of quaternion length and SH energy, all standardised. Positions are left out: they would cut the scene in
    pieces. A model of fewer than ten Gaussians is one group, and the others are empty.
    """
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.mixture import GaussianMixture
    from threadpoolctl import threadpool_limits

    if len(model) < _LEAST_CLUSTERED:
        return [opaque(model)] + [model[:0]] * (count - 1)
    rows = _standardised(model).cpu().double().numpy()
    some = np.random.default_rng(seed).permutation(len(rows))[:_CLUSTER_SAMPLE]
    mixture = GaussianMixture(count, reg_covar=1e-3, random_state=seed)
    # The matrices are 9 by 9: waking threads for each takes a hundred times as long as the work.
    with threadpool_limits(1), warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # an unsettled one tells groups apart as well
        mixture.fit(rows[some])
    labels = torch.from_numpy(mixture.predict(rows)).to(model.device)
    order = torch.bincount(labels, minlength=count).argsort(descending=True, stable=True)
    return [opaque(model[labels == label]) for label in order]


def _standardised(model: Gaussians) -> Tensor:
    """[N, 9]"""
    columns = [
        model.opacity_logits[:, None],
        model.log_scales.sort(dim=1).values,
        model.sh[:, 0],
        measured(model, "quaternion length")[:, None],
        measured(model, "SH energy")[:, None],
    ]
    features = torch.cat(columns, dim=1)
    spread = features.std(dim=0, correction=0).clamp_min(_LEAST_SPREAD)
    return (features - features.mean(dim=0)) / spread
