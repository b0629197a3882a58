"""What the joint training starts from: the sparse points of all scenes (KeySS, section 3.4)."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from keyss.core.gaussians import Gaussians
from keyss.fitting.parameters import initial_gaussians, initial_points
from keyss.methods.learned.options import LearnedOptions, chosen_scenes
from keyss.methods.learned.room import divided
from keyss.methods.learned.targets import PlacedScene


def make_start(
    scenes: Sequence[PlacedScene], config: LearnedOptions, generator: torch.Generator
) -> Gaussians:
    """Combined SfM points: an equal share of the cap for every scene, what one leaves goes to the others."""
    fit = config.fit
    chosen = [scenes[index].scene for index in chosen_scenes(config.points, len(scenes))]
    clouds = [initial_points(scene, fit.max_gaussians, generator) for scene in chosen]
    counts = divided([len(points) for points, _ in clouds], [1.0] * len(clouds), fit.max_gaussians)
    parts = [
        initial_gaussians(points, colors, fit.sh_degree, share, generator)
        for (points, colors), share in zip(clouds, counts, strict=True)
    ]
    return Gaussians.cat(parts)
