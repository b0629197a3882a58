"""Moves scenes away from the thresholds of the rasterizer.

Images and gradients are discontinuous at thresholds: minimum and maximum alpha, the end of a pixel, the near
plane, the depth order, the clamp at black. Two correct implementations may differ there by more than
rounding. Scenes away from thresholds need neither masks nor loose tolerances.
"""

from __future__ import annotations

import torch
from torch import Tensor

from rendering.dense_reference import Margins, dense_rasterization
from rendering.scenes import Scene

# Minimum distances: several float32 rounding errors. Alphas and transmittance are relative to the threshold,
# the others absolute, in scenes a few units large.
REQUIRED = {
    "alpha 1/255": 3e-4,
    "alpha 0.999": 3e-4,
    "transmittance": 3e-4,
    "near plane": 1e-5,
    "order": 1e-5,
    "the view where the perspective is linearised": 1e-5,
    "black": 1e-5,
}
ROUNDS = 60


def margins(scene: Scene) -> Margins:
    """Minimum distance [N] of each Gaussian to each threshold."""
    found: Margins = {}
    with torch.no_grad():
        dense_rasterization(**scene.dense_arguments(scene.leaves(torch.float64)), margins=found)
    return found


def close_calls(scene: Scene) -> dict[str, Tensor]:
    """Gaussians too close to each threshold."""
    return {
        name: (values < REQUIRED[name]).nonzero()[:, 0]
        for name, values in margins(scene).items()
        if (values < REQUIRED[name]).any()
    }


def clear_cut(scene: Scene) -> Scene:
    """Perturb Gaussians until there are no close calls."""
    generator = torch.Generator().manual_seed(12345)

    def normal(like: Tensor) -> Tensor:
        return torch.randn(like.shape, generator=generator, dtype=torch.float64)

    for _ in range(ROUNDS):
        found = close_calls(scene)
        if not found:
            return scene
        for name, which in found.items():
            if name in ("alpha 1/255", "alpha 0.999", "transmittance"):
                factors = 0.9 + 0.1 * torch.rand(len(which), generator=generator, dtype=torch.float64)
                scene.opacities[which] *= factors
            elif name == "black":
                scene.colors[which] += 0.01 * normal(scene.colors[which])
            else:
                scene.means[which] += 1e-3 * normal(scene.means[which])
        scene.round()
    raise AssertionError(f"close calls remain: { {name: len(which) for name, which in found.items()} }")
