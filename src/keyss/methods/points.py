"""The start of a joint training: the sparse points of all scenes (KeySS, section 3.4)."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.fitting.config import FitConfig
from keyss.fitting.parameters import initial_gaussians, initial_points


def combined_points(scenes: Sequence[Scene], fit: FitConfig, generator: torch.Generator) -> Gaussians:
    """Gaussians at the points of all scenes, in equal shares of the cap as far as there are points."""
    clouds = [initial_points(scene, fit.max_gaussians, generator) for scene in scenes]
    counts = divided([len(points) for points, _ in clouds], fit.max_gaussians)
    parts = [
        initial_gaussians(points, colors, fit.sh_degree, share, generator)
        for (points, colors), share in zip(clouds, counts, strict=True)
    ]
    return Gaussians.cat(parts)


def divided(available: Sequence[int], total: int) -> list[int]:
    """`total` items in equal shares, each at most what is `available`; the others share the rest."""
    shares = [0] * len(available)
    left = total
    for done, index in enumerate(sorted(range(len(available)), key=lambda i: available[i])):
        shares[index] = min(available[index], left // (len(available) - done))
        left -= shares[index]
    return shares
