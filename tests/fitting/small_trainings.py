"""Small trainings of every kind."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch

import keyss  # noqa: F401  before anything imports torch
from keyss.core import Similarity
from keyss.fitting import FitConfig, PlainRun, TrainingRun, train
from keyss.keys import random_embeddings
from keyss.methods import KeyssTraining, PlacedScene, registry
from methods.keyss.small import small
from tiny_scenes import random_gaussians, tiny_scene

# Densified at 20 and 30 of 50 steps.
FIT = FitConfig(
    iterations=50, max_gaussians=999, sh_degree=1, grow_start=0.2, grow_stop=0.7, grow_every=10, seed=3
)


def plain(fit: FitConfig, device: torch.device) -> PlainRun:
    return PlainRun(tiny_scene(), fit, device)


def joint(fit: FitConfig, device: torch.device) -> KeyssTraining:
    """KeySS with wrong keys, poses of both scenes, and all attributes decoded."""
    options = small("published", fit, common_poses=0.5)
    keys = list(random_embeddings(1, torch.Generator().manual_seed(0)))
    return KeyssTraining(placed(), keys, options, device)


def gs_hider(fit: FitConfig, device: torch.device) -> KeyssTraining:
    """A baseline with networks, and with features in place of harmonics."""
    method: Any = registry.get("gs-hider")
    options = method.options(fit=fit, common_poses=0.5)
    return method.training(placed(), options, device)  # type: ignore[no-any-return]


RUNS: Mapping[str, Callable[[FitConfig, torch.device], Any]] = {
    "plain": plain,
    "joint": joint,
    "gs-hider": gs_hider,
}


def train_run(name: str, fit: FitConfig, device: str = "cpu", **options: Any) -> TrainingRun:
    """Train one of RUNS to its end."""
    run: TrainingRun = RUNS[name](fit, torch.device(device))
    train(run, name, fingerprint={}, **options)
    return run


def placed(sh_degree: int = 1) -> list[PlacedScene]:
    """Two scenes in one frame."""
    scenes = [tiny_scene(0), tiny_scene(1)]
    models = [random_gaussians(seed=seed, sh_degree=sh_degree) for seed in (0, 1)]
    return [PlacedScene.of(*each, Similarity()) for each in zip(scenes, models, strict=True)]
