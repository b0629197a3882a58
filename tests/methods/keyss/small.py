"""Small options of KeySS."""

from __future__ import annotations

from dataclasses import replace

import torch

from keyss import FitConfig, Gaussians, KeyssOptions
from keyss.core import Scene
from keyss.core.similarity import Similarity
from keyss.keys import random_embeddings
from keyss.methods import DESIGNS, KeyssTraining, PlacedScene
from keyss.methods.keyss.method import training_of

FIT = FitConfig(iterations=60, max_gaussians=600, grow_start=0.2, grow_every=20, evaluate_every=0, seed=0)
KEYS = ("first key", "second key")
VECTORS = random_embeddings(3, torch.Generator().manual_seed(1234))


def small(design: str, **changes: object) -> KeyssOptions:
    """A design with a decoder of few bytes, a few steps, and changed fields of the design."""
    known = DESIGNS[design]
    decoder = replace(known.decoder, hidden=(16, 16), branch=8)
    return KeyssOptions(fit=FIT, design=replace(known, decoder=decoder, **changes))  # type: ignore[arg-type]


def begun(options: KeyssOptions, scenes: list[Scene], models: list[Gaussians]) -> KeyssTraining:
    """A training of scenes that are in one frame, before its first step."""
    placed = [PlacedScene.of(scene, model, Similarity()) for scene, model in zip(scenes, models, strict=True)]
    design = options.configuration
    if design.ssim_weight is not None:
        options = options.with_fit(ssim_weight=design.ssim_weight)
    keys = list(VECTORS[: len(scenes) - 1])
    return training_of(design)(placed, keys, options, design, torch.device("cpu"))
