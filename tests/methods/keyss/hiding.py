"""Small options of KeySS, and a secret of its own making."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch

from keyss import FitConfig, Gaussians, KeyssOptions
from keyss.core.similarity import Similarity
from keyss.keys import random_embeddings
from keyss.methods import ATTRIBUTES, Decoder, DecoderShape, HiddenSecret, choose_anchors

FIT = FitConfig(iterations=80, max_gaussians=600, grow_start=0.2, grow_every=20, evaluate_every=0, seed=0)
SMALL: dict[str, Any] = {"hidden": (16, 16), "branch": 8}  # a decoder of few bytes
OPTIONS = KeyssOptions(design="mlp", fit=FIT, mask=ATTRIBUTES, decoder_rate=1e-2, **SMALL)
# The paper's, but small and with inputs that learn in few steps.
PUBLISHED = KeyssOptions(
    fit=replace(FIT, iterations=60), design="published", inputs="standardised", decoder_rate=3e-3, **SMALL
)
KEYS = ("first key", "second key")


def some_secret(stego: Gaussians) -> HiddenSecret:
    """A secret that `stego` belongs to, whose decoder changes opacities a little."""
    generator = torch.Generator().manual_seed(0)
    torch.manual_seed(0)
    decoder = Decoder(DecoderShape(hidden=(8, 8), branch=8, sh_degree=stego.sh_degree))
    decoder.prepare(stego, random_embeddings(1, generator)[0])
    torch.nn.init.normal_(decoder.network.branches["op"][-1].weight, std=0.01, generator=generator)  # type: ignore[index,union-attr,arg-type]
    frame = Similarity(1.001, translation=torch.full((3,), 0.01, dtype=torch.float64))
    return HiddenSecret(decoder.requires_grad_(False), frame, choose_anchors(stego, generator))
