"""Models distributed as after training, and changes that measures should detect."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import torch
import torch.nn.functional as F
from scipy.spatial.transform import Rotation

from keyss.core import SH_C0, Gaussians, Similarity


def lifelike(count: int, seed: int = 0) -> Gaussians:
    """Flat Gaussians, mostly transparent and of one orientation, a few huge; colour depends on position."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    means = normal(count, 3) * torch.exp(0.5 * normal(count, 1))
    log_scales = -4 + 1.25 * normal(count, 1) + 0.35 * normal(count, 3) - torch.tensor([0.0, 0.0, 1.0])
    log_scales[: count // 100] += 2.5
    x, y, z = means.unbind(1)
    rgb = torch.sigmoid(torch.stack([1 + x + 0.5 * y, y, z - 0.7 * x - 1], dim=1) + 0.6 * normal(count, 3))
    sh = 0.1 * normal(count, 16, 3)
    sh[:, 0] = (rgb - 0.5) / SH_C0
    return Gaussians(
        means=means,
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]) + 0.35 * normal(count, 4),
        log_scales=log_scales,
        opacity_logits=-2.1 + 1.5 * normal(count),
        sh=sh,
    )


def doubled_scales(model: Gaussians) -> Gaussians:
    return replace(model, log_scales=model.log_scales + math.log(2))


def random_rotations(model: Gaussians) -> Gaussians:
    quats = torch.randn(len(model), 4, generator=torch.Generator().manual_seed(9))
    return replace(model, quats=F.normalize(quats, dim=1) * model.quats.norm(dim=1, keepdim=True))


def tripled_positions(model: Gaussians) -> Gaussians:
    return replace(model, means=3 * model.means)


def red_for_blue(model: Gaussians) -> Gaussians:
    """Swap red and blue of the constant colours."""
    return replace(model, sh=torch.cat([model.sh[:, :1].flip(2), model.sh[:, 1:]], dim=1))


def stronger_harmonics(model: Gaussians) -> Gaussians:
    return replace(model, sh=torch.cat([model.sh[:, :1], 5 * model.sh[:, 1:]], dim=1))


def some_transparent(model: Gaussians) -> Gaussians:
    """A random 5 % of opacities become 0.005."""
    logits = model.opacity_logits.clone()
    chosen = torch.randperm(len(model), generator=torch.Generator().manual_seed(9))[: len(model) // 20]
    logits[chosen] = math.log(0.005 / 0.995)
    return replace(model, opacity_logits=logits)


def rescaled_quaternions(model: Gaussians) -> Gaussians:
    """Scale lengths by 0.5 to 2; renders do not change."""
    factors = 0.5 + 1.5 * torch.rand(len(model), 1, generator=torch.Generator().manual_seed(9))
    return replace(model, quats=model.quats * factors)


def turned(scale: float) -> Callable[[Gaussians], Gaussians]:
    """Another frame: rotated, moved and scaled."""
    rotation = torch.from_numpy(Rotation.from_euler("xyz", [0.3, 1.1, -2.0]).as_matrix())
    move = torch.tensor([30.0, -2.0, 5.0], dtype=torch.float64)
    return Similarity(scale, rotation, move).apply_gaussians


# Changes, and the attributes that they affect.
CHANGES: dict[Callable[[Gaussians], Gaussians], set[str]] = {
    doubled_scales: {"scale"},
    random_rotations: {"rotation"},
    tripled_positions: {"position"},
    red_for_blue: {"colour"},
    stronger_harmonics: {"harmonics"},
    some_transparent: {"opacity"},
    rescaled_quaternions: set(),
}
