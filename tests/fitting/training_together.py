"""Small trainings, and a program that runs them in two processes of torchrun."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

import keyss  # noqa: F401  before anything imports torch
from keyss.core import Similarity
from keyss.fitting import FitConfig, PlainRun, TrainingRun, here, joined, save_checkpoint, train
from keyss.keys import random_embeddings
from keyss.methods import KeyssTraining, PlacedScene, registry
from methods.keyss.small import small
from tiny_scenes import random_gaussians, tiny_scene

SEED = 3
# Densified at 20 and 30 of 50 steps; WaterGS trains its autoencoder from step 35 on.
FIT = FitConfig(
    iterations=50, max_gaussians=999, sh_degree=1, grow_start=0.2, grow_stop=0.7, grow_every=10, seed=SEED
)


def plain(fit: FitConfig, device: torch.device) -> PlainRun:
    return PlainRun(tiny_scene(), fit, device)


def joint(fit: FitConfig, device: torch.device) -> KeyssTraining:
    """With wrong keys, poses of both scenes, and all attributes decoded."""
    options = small("published", fit, common_poses=0.5)
    keys = list(random_embeddings(1, torch.Generator().manual_seed(0)))
    return KeyssTraining(_placed(), keys, options, options.configuration, device)


def watergs(fit: FitConfig, device: torch.device) -> KeyssTraining:
    """A peer with a network, and with parameters that have no gradients at the end."""
    method: Any = registry.get("watergs")
    options = method.options(fit=fit, common_poses=0.5)
    return method.training(_placed(), options, device)  # type: ignore[no-any-return]


RUNS: Mapping[str, Callable[[FitConfig, torch.device], Any]] = {
    "plain": plain,
    "joint": joint,
    "watergs": watergs,
}


def trained(name: str, fit: FitConfig, device: str = "cpu", **options: Any) -> TrainingRun:
    """One of RUNS, trained to its end."""
    run: TrainingRun = RUNS[name](fit, torch.device(device))
    train(run, name, fit, fingerprint={}, **options)
    return run


def _placed() -> list[PlacedScene]:
    scenes = [tiny_scene(0), tiny_scene(1)]
    models = [random_gaussians(seed=seed, sh_degree=1) for seed in (0, 1)]
    return [PlacedScene.of(*each, Similarity()) for each in zip(scenes, models, strict=True)]


def main(folder: Path, device: str) -> None:
    """Each process writes its final state; the ranks start with different seeds."""
    with joined(device):
        for name in RUNS:
            rank = here().rank
            run = trained(name, replace(FIT, seed=SEED + rank), device)
            save_checkpoint(folder / f"{name}-{rank}", *run.state())


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])
