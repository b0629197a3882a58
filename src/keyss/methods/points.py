"""What a joint training starts from: the sparse points of all scenes (KeySS, section 3.4)."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.fitting.config import FitConfig
from keyss.fitting.parameters import initial_gaussians, initial_points


def combined_points(scenes: Sequence[Scene], fit: FitConfig, generator: torch.Generator) -> Gaussians:
    """An equal share of the cap for every scene, all in one frame; what one leaves goes to the others."""
    clouds = [initial_points(scene, fit.max_gaussians, generator) for scene in scenes]
    counts = divided([len(points) for points, _ in clouds], [1.0] * len(clouds), fit.max_gaussians)
    parts = [
        initial_gaussians(points, colors, fit.sh_degree, share, generator)
        for (points, colors), share in zip(clouds, counts, strict=True)
    ]
    return Gaussians.cat(parts)


def divided(available: Sequence[int], weights: Sequence[float], total: int) -> list[int]:
    """`total` items divided by `weights`, nowhere more than `available`; what is left over is given on."""
    shares = [0] * len(available)
    while (left := total - sum(shares)) > 0:
        open_ends = [i for i in range(len(available)) if shares[i] < available[i]]
        if not open_ends:
            break
        weight = sum(weights[i] for i in open_ends)
        for i in open_ends:
            fair = max(1, int(left * weights[i] / weight))
            shares[i] += min(fair, available[i] - shares[i], total - sum(shares))
    return shares
