"""Small trainings of every kind."""

from __future__ import annotations

from typing import Any

import torch

import keyss  # noqa: F401  before anything imports torch
from keyss.core import Similarity
from keyss.fitting import FitConfig, PlainRun
from keyss.keys import random_embeddings
from keyss.methods import DESIGNS, KeyssTraining, PlacedScene, registry
from methods.keyss.small import small
from tiny_scenes import random_gaussians, tiny_scene

# Densified at 20 and 30 of 50 steps.
FIT = FitConfig(
    iterations=50, max_gaussians=999, sh_degree=1, grow_start=0.2, grow_stop=0.7, grow_every=10, seed=3
)


def training(name: str, fit: FitConfig, device: torch.device) -> Any:
    """The training of a plain model, or of two scenes in one frame by a design or a baseline."""
    if name == "plain":
        return PlainRun(tiny_scene(), fit, device)
    scenes = [
        PlacedScene.of(tiny_scene(seed), random_gaussians(seed=seed, sh_degree=fit.sh_degree), Similarity())
        for seed in (0, 1)
    ]
    if name not in DESIGNS:
        method: Any = registry.get(name)
        return method.training(scenes, [], method.options(fit=fit, common_poses=0.5), device)
    keys = list(random_embeddings(1, torch.Generator().manual_seed(0)))
    return KeyssTraining(scenes, keys, small(name, fit, common_poses=0.5), device)
