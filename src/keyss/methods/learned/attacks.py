"""What somebody makes of a stego model who has no key, and has read the source of this method."""

from __future__ import annotations

import math
from dataclasses import replace

import torch

from keyss.core.gaussians import Gaussians
from keyss.methods.learned.decoder import Decoder, DecoderShape
from keyss.methods.learned.opacity_band import DRAWN_LOGIT, OpacityBand, opacity_remap

_OPAQUE_LOGIT = math.log(0.99 / 0.01)  # as much as one Gaussian covers in 3DGS


def known_remaps(stego: Gaussians, secrets: int) -> dict[str, Gaussians]:
    """`stego` with the opacity remap of each of so many secrets, and what is transparent for all of them.

    A Gaussian of a secret that left its opacity band while training would be among the last.
    """
    decoder = Decoder(DecoderShape()).to(stego.device)
    decoder.prepare(stego, torch.ones_like(decoder.key))
    logits, shown = stego.opacity_logits, {}
    stray = logits < DRAWN_LOGIT
    for secret in range(secrets):
        decoder.set_remap(*opacity_remap(secret))
        shown[f"secret {secret + 1}"] = decoder(stego, decoder.key)
        stray = stray & ~OpacityBand.of_secret(secret).contains(logits)
    outside = stego[stray]
    opaque = torch.full_like(outside.opacity_logits, _OPAQUE_LOGIT)
    return {**shown, "outside the bands": replace(outside, opacity_logits=opaque)}
