"""What somebody tries without a key who has read how this method hides: models to be rendered."""

from __future__ import annotations

import math
from dataclasses import replace

import torch

from keyss.core.gaussians import DRAWN_OPACITY, Gaussians
from keyss.methods.learned.decoder import Decoder, DecoderShape
from keyss.methods.learned.start import opacity_curve

_OPAQUE_LOGIT = math.log(0.99 / 0.01)  # as much as one Gaussian covers in 3DGS
_DRAWN_LOGIT = math.log(DRAWN_OPACITY / (1 - DRAWN_OPACITY))


def attacks(stego: Gaussians, secrets: int) -> dict[str, Gaussians]:
    """By name, what a stego model shows for each of so many secrets, and what lies in none of their bands."""
    stray = outside_the_bands(stego, secrets)
    opaque = replace(stray, opacity_logits=torch.full_like(stray.opacity_logits, _OPAQUE_LOGIT))
    shown = {f"secret {index + 1}": by_the_source(stego, index) for index in range(secrets)}
    return {**shown, "outside the bands": opaque}


def by_the_source(model: Gaussians, secret: int) -> Gaussians:
    """With the opacities that this method's source tells of a warm start's secret (0, 1, ...)."""
    decoder = Decoder(DecoderShape()).to(model.device)
    decoder.prepare(model, torch.ones_like(decoder.key))
    decoder.set_curve(*opacity_curve(secret))
    shown: Gaussians = decoder(model, decoder.key)
    return shown


def outside_the_bands(model: Gaussians, secrets: int) -> Gaussians:
    """The Gaussians alone that are never drawn but lie in no band of the first so many secrets.

    A Gaussian of a secret that left its band while training would be one of them.
    """
    logits = model.opacity_logits
    stray = logits < _DRAWN_LOGIT
    for secret in range(secrets):
        knots, _ = opacity_curve(secret)
        stray = stray & ~((logits > knots[1]) & (logits < knots[4]))
    return model[stray]
