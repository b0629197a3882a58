"""Small options of KeySS."""

from __future__ import annotations

from dataclasses import replace

import torch

from keyss import FitConfig, Gaussians, KeyssOptions
from keyss.core import Scene
from keyss.core.similarity import Similarity
from keyss.keys import random_embeddings
from keyss.methods import (
    DESIGNS,
    Decoder,
    DecoderShape,
    KeyssSecret,
    KeyssTraining,
    PlacedScene,
    choose_anchors,
)
from keyss.methods.keyss.method import training_of
from keyss.methods.keyss.secret import visibility

FIT = FitConfig(iterations=60, max_gaussians=600, grow_start=0.2, grow_every=20, evaluate_every=0, seed=0)
KEYS = ("first key", "second key")
VECTORS = random_embeddings(3, torch.Generator().manual_seed(1234))


def small(design: str, fit: FitConfig = FIT, **changes: object) -> KeyssOptions:
    """A design with a decoder of few bytes, a few steps, and changed fields of the design."""
    known = DESIGNS[design]
    decoder = replace(known.decoder, hidden=(8, 8), branch=8)
    return KeyssOptions(fit=fit, design=replace(known, decoder=decoder, **changes))  # type: ignore[arg-type]


def begun(options: KeyssOptions, scenes: list[Scene], models: list[Gaussians]) -> KeyssTraining:
    """A training of scenes that are in one frame, before its first step."""
    placed = [PlacedScene.of(scene, model, Similarity()) for scene, model in zip(scenes, models, strict=True)]
    design = options.configuration
    if design.ssim_weight is not None:
        options = options.with_fit(ssim_weight=design.ssim_weight)
    keys = list(VECTORS[: len(scenes) - 1])
    return training_of(design)(placed, keys, options, design, torch.device("cpu"))


def some_secret(stego: Gaussians) -> KeyssSecret:
    """A secret that `stego` belongs to, whose decoder of few bytes changes opacities a little."""
    torch.manual_seed(0)
    shape = DecoderShape(mask=("op",), hidden=(8, 8), branch=8, sh_degree=stego.sh_degree)
    decoder = Decoder(shape).requires_grad_(False)
    decoder.branches["op"][-1].weight *= 0.01
    decoder.branches["op"][-1].bias *= 0.01
    frame = Similarity(1.001, translation=torch.full((3,), 0.01, dtype=torch.float64))
    key = VECTORS[0]
    return KeyssSecret(decoder, key, frame, choose_anchors(stego, 0), *visibility(decoder.decode(stego, key)))
