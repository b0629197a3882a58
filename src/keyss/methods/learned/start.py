"""What the joint training starts from: the sparse points of the scenes that are asked for."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from keyss.core.gaussians import Gaussians
from keyss.methods.learned.options import LearnedOptions, chosen_scenes
from keyss.methods.points import combined_points
from keyss.methods.poses import PlacedScene


def make_start(
    scenes: Sequence[PlacedScene], config: LearnedOptions, generator: torch.Generator
) -> Gaussians:
    """Combined SfM points."""
    chosen = [scenes[index].scene for index in chosen_scenes(config.points, len(scenes))]
    return combined_points(chosen, config.fit, generator)
