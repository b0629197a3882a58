"""Small KeySS options and secrets."""

from __future__ import annotations

from dataclasses import replace

import torch

from keyss import FitConfig, Gaussians, KeyssOptions
from keyss.core.similarity import Similarity
from keyss.keys import random_embeddings
from keyss.methods import DESIGNS, Decoder, DecoderShape, KeyssSecret, choose_anchors
from keyss.methods.keyss.keyss_method import count_visible

FIT = FitConfig(
    iterations=60,
    max_gaussians=600,
    grow_start=0.2,
    grow_every=20,
    grow_gradient=1e-6,
    evaluate_every=0,
    seed=0,
)
KEYS = ("first key", "second key")
VECTORS = random_embeddings(3, torch.Generator().manual_seed(1234))


def small(design: str, fit: FitConfig = FIT, **changes: object) -> KeyssOptions:
    """Options of a design with a tiny decoder."""
    known = DESIGNS[design]
    decoder = replace(known.decoder, hidden=(8, 8), branch=8)
    return KeyssOptions(fit=fit, design=replace(known, decoder=decoder, **changes))  # type: ignore[arg-type]


def make_secret(stego: Gaussians) -> KeyssSecret:
    """A secret in `stego` whose decoder changes opacities slightly."""
    torch.manual_seed(0)
    shape = DecoderShape(mask=("op",), hidden=(8, 8), branch=8, sh_degree=stego.sh_degree)
    decoder = Decoder(shape).requires_grad_(False)
    torch.nn.init.normal_(decoder.outer["op"].weight, std=0.003)
    frame = Similarity(1.001, translation=torch.full((3,), 0.01, dtype=torch.float64))
    key = VECTORS[0]
    return KeyssSecret(decoder, key, frame, choose_anchors(stego, 0), count_visible(decoder(stego, key)))
