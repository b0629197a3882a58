"""Changes of a model that make transparent or unusual Gaussians visible.

Transparent Gaussians may belong to a secret (KeySS, figures 2 and 6). A second scene that is stored in
attributes that do not render (lengths of quaternions, harmonics of transparent Gaussians), or trained
differently, may form a group of its own. Functions change nothing in place.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from keyss.core import Gaussians, import_extra

Attribute = Literal["quaternion length", "scale", "SH energy"]
Side = Literal["low", "high"]

OPAQUE = 0.99  # the maximum alpha of a Gaussian in 3DGS
_BRIGHTEST = 0.99  # the quantile that rescaling makes OPAQUE, robust to outliers
_TO_SIGMA = 1.4826  # from a median absolute deviation to the standard deviation of a normal distribution
_MIN_SPREAD = 1e-3  # of a logarithm: attributes that differ by rounding have no outliers
_MIN_LENGTH = 1e-12
_CLUSTER_SAMPLE = 5000  # Gaussians used to find clusters
_MIN_CLUSTERED = 10


def opaque(model: Gaussians) -> Gaussians:
    """All Gaussians with opacity OPAQUE."""
    logit = math.log(OPAQUE / (1 - OPAQUE))
    return replace(model, opacity_logits=torch.full_like(model.opacity_logits, logit))


def faint(model: Gaussians, below: float) -> Gaussians:
    """Only the Gaussians with opacities under `below`, unchanged."""
    return model[model.opacities < below]


def rescaled(model: Gaussians) -> Gaussians:
    """Opacities times the factor that makes the largest ones OPAQUE."""
    if len(model) == 0:
        return model
    opacities = model.opacity_logits.double().sigmoid()
    top = opacities.sort().values[int(_BRIGHTEST * (len(model) - 1))]
    scaled = (opacities * (OPAQUE / top)).clamp(max=OPAQUE)
    return replace(model, opacity_logits=scaled.logit().to(model.opacity_logits))


def matched(model: Gaussians, below: float) -> Gaussians:
    """The Gaussians with opacities under `below`, with the opacities of the others by rank.

    Undoes any monotone reduction of opacities.
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
    """The `share` of the Gaussians that contribute least: `weights` [N] of `contributions`."""
    return model[weights.argsort(stable=True)[: round(share * len(model))]]


def measured(model: Gaussians, attribute: Attribute) -> Tensor:
    """[N] natural logarithm of the quaternion's length, of the geometric mean of the scales, or of the sum of
    squares of the harmonics above the constant one."""
    if attribute == "scale":
        return model.log_scales.mean(dim=1)
    size = (
        model.quats.norm(dim=1) if attribute == "quaternion length" else model.sh[:, 1:].square().sum((1, 2))
    )
    logarithm: Tensor = size.clamp_min(_MIN_LENGTH).log()
    return logarithm


def outliers(model: Gaussians, attribute: Attribute, side: Side, threshold: float) -> Gaussians:
    """Only the Gaussians whose robust z-score in an attribute is beyond the threshold, made opaque.

    The score is the distance from the model's median over the standard deviation estimated by the median
    absolute deviation, negated on the low side.
    """
    if len(model) == 0:
        return model
    values = measured(model, attribute)
    middle = values.median()
    spread = _TO_SIGMA * (values - middle).abs().median()
    score = (values - middle) / spread.clamp_min(_MIN_SPREAD)
    return opaque(model[(score if side == "high" else -score) > threshold])


def clusters(model: Gaussians, count: int, seed: int = 0) -> list[Gaussians]:
    """`count` groups of similar Gaussians, each alone and made opaque, the largest first.

    A Gaussian mixture of opacity logit, sorted log scales, constant colour, and the logarithms of quaternion
    length and SH energy, all standardised. Without positions, which would cut the scene into pieces. A model
    of fewer than ten Gaussians is one group, and the others are empty.
    """
    if len(model) < _MIN_CLUSTERED:
        return [opaque(model)] + [model[:0]] * (count - 1)
    rows = _standardised(model).cpu().double().numpy()
    some = np.random.default_rng(seed).permutation(len(rows))[:_CLUSTER_SAMPLE]
    mixtures = import_extra("sklearn.mixture", "audit", "find clusters")
    threadpoolctl = import_extra("threadpoolctl", "audit", "find clusters")
    mixture = mixtures.GaussianMixture(count, reg_covar=1e-3, random_state=seed)
    # For matrices of 9 x 9, starting threads takes a hundred times as long as the work.
    with threadpoolctl.threadpool_limits(1), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a mixture that has not converged is good enough
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
    spread = features.std(dim=0, correction=0).clamp_min(_MIN_SPREAD)
    return (features - features.mean(dim=0)) / spread
