"""Changes scenes until no decision of the rasterizer is a close call.

The rasterizer decides: whether an alpha is too faint, whether it is clamped, whether a pixel has stopped,
what lies before the near plane, what comes first, where a colour is clamped at black. At a threshold the
picture or its gradient jumps, so two right answers that differ by rounding may differ by much. Here the
scene is changed until nothing is near to a threshold: then tests need neither masks nor loose tolerances.
"""

from __future__ import annotations

import torch
from torch import Tensor

from rendering.dense_reference import Margins, dense_rasterization
from rendering.scenes import Scene

# How far to stay away: several times the rounding errors of float32 in the quantity that is compared.
# Alphas and transmittance relative to the threshold, the others absolute, in scenes a few units large.
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
    """The minimum distance [N] of each Gaussian to each threshold, over all cameras."""
    least: Margins = {}
    leaves = scene.leaves(torch.float64)
    with torch.no_grad():
        for camera in range(len(scene.viewmats)):
            found: Margins = {}
            dense_rasterization(**scene.dense_arguments(leaves, camera), margins=found)
            for name, values in found.items():
                least[name] = torch.minimum(values, least.get(name, values))
    return least


def close_calls(scene: Scene) -> dict[str, Tensor]:
    """The Gaussians that are too close to a threshold, by its name."""
    return {
        name: (values < REQUIRED[name]).nonzero()[:, 0]
        for name, values in margins(scene).items()
        if (values < REQUIRED[name]).any()
    }


def clear_cut(scene: Scene) -> Scene:
    """The scene with small changes to Gaussians until there are no close calls."""
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
