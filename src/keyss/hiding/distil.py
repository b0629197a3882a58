"""Teaching a new decoder who belongs to which scene, before any picture is drawn.

In a warm start it is known which Gaussian each key should show, so the decoder can be taught that
directly, Gaussian by Gaussian, in seconds; wrong keys are taught to change nothing. Joint training then
starts from pictures that are nearly right instead of destroying the plain models while the decoder learns.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from keyss.core.gaussians import Gaussians
from keyss.hiding.config import HideConfig
from keyss.hiding.decoder import Decoder
from keyss.seal.keys import random_embeddings

BATCH = 4096


def distil(
    decoder: Decoder,
    gaussians: Gaussians,
    embedding: Tensor,  # [64]
    opacity_logits: Tensor,  # [N]
    config: HideConfig,
    generator: torch.Generator,
) -> None:
    """Train `decoder` so that the key with `embedding` gives `opacity_logits`, and others change nothing.

    All other attributes are held where they are.
    """
    if "op" not in decoder.shape.mask:
        return
    optimizer = torch.optim.Adam(decoder.parameters(), lr=config.distil_rate)
    device = gaussians.device
    for step in range(config.distil_steps):
        optimizer.param_groups[0]["lr"] = config.distil_rate * (1 - step / config.distil_steps) + 1e-5
        batch = torch.randint(len(gaussians), (min(BATCH, len(gaussians)),), generator=generator).to(device)
        part = gaussians[batch]
        description = decoder.describe(part)
        wrong = random_embeddings(1, generator)[0].to(device)
        loss = _distance(decoder(part, wrong, description), part, part.opacity_logits, decoder)
        right = decoder(part, embedding, description)
        loss = loss + _distance(right, part, opacity_logits[batch], decoder)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()


def _distance(decoded: Gaussians, original: Gaussians, logits: Tensor, decoder: Decoder) -> Tensor:
    """How far the opacities are from `logits`, and every other attribute from the original's.

    Logits alone would spend everything on invisible Gaussians, opacities alone would not tell hardly
    visible from invisible: both count.
    """
    opacity = F.smooth_l1_loss(decoded.opacity_logits / 4, logits / 4, beta=0.25) + 4 * F.mse_loss(
        decoded.opacities, logits.sigmoid()
    )
    moved = ((decoded.means - original.means) / decoder.extent).square().mean()
    turned = (decoded.quats - original.quats).square().mean()
    scaled = (decoded.log_scales - original.log_scales).square().mean()
    coloured = (decoded.sh - original.sh).square().mean()
    return opacity + moved + turned + scaled + coloured
