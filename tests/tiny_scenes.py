"""Synthetic scenes of a few Gaussians seen by a ring of small cameras."""

from __future__ import annotations

import math
from functools import cache

import torch
from torch import Tensor

from keyss.core import SH_C0, Camera, Gaussians, Scene, View
from keyss.rendering import render

WIDTH, HEIGHT = 40, 30


def ring_cameras(count: int = 16, distance: float = 4.0, height: float = 1.0) -> list[Camera]:
    """Cameras on a circle about the world's z axis, looking at the origin, z up."""
    cameras = []
    for index in range(count):
        angle = 2 * math.pi * index / count
        position = torch.tensor([distance * math.cos(angle), distance * math.sin(angle), height])
        forward = -position / position.norm()
        right = torch.linalg.cross(forward, torch.tensor([0.0, 0.0, 1.0]))
        right = right / right.norm()
        rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
        viewmat = torch.eye(4)
        viewmat[:3, :3] = rotation
        viewmat[:3, 3] = -rotation @ position
        K = torch.tensor([[WIDTH, 0, WIDTH / 2], [0, WIDTH, HEIGHT / 2], [0, 0, 1.0]])
        cameras.append(Camera(viewmat, K, WIDTH, HEIGHT, f"{index:03d}.png"))
    return cameras


def random_gaussians(count: int = 200, seed: int = 0, sh_degree: int = 3) -> Gaussians:
    """Coloured Gaussians in the unit ball."""
    generator = torch.Generator().manual_seed(seed)
    k = (sh_degree + 1) ** 2
    sh = 0.05 * torch.randn(count, k, 3, generator=generator)
    sh[:, 0] = (torch.rand(count, 3, generator=generator) - 0.5) / SH_C0
    model = Gaussians(
        means=0.5 * torch.randn(count, 3, generator=generator),
        quats=torch.randn(count, 4, generator=generator),
        log_scales=_to_the_last_bit(math.log(0.12) + 0.3 * torch.randn(count, 3, generator=generator)),
        opacity_logits=_to_the_last_bit(1 + torch.randn(count, generator=generator)),
        sh=_to_the_last_bit(sh),
    )
    # Noise in the low bits, as trained models have it: multiples of float32 numbers have correlated ones.
    return model.map(
        lambda values: (
            values * (1 + 1e-6 * torch.randn(values.shape, generator=generator, dtype=torch.float64))
        ).float()
    )


def _to_the_last_bit(values: Tensor) -> Tensor:
    """Noise below the grid of float32: a rounded sum has the grid of its larger part."""
    noise = torch.rand(values.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    return (values.double() + 2e-6 * (noise - 0.5)).float()


@cache
def tiny_scene(seed: int = 0, views: int = 16, distance: float = 4.0) -> Scene:
    """Photos of `random_gaussians(seed=seed)`, with its noisy means as sparse points."""
    model = random_gaussians(seed=seed)
    generator = torch.Generator().manual_seed(seed + 1000)
    shots = []
    for camera in ring_cameras(views, distance):
        image = render(model, camera).clamp(0, 1)
        shots.append(View(camera, (image * 255).round().to(torch.uint8)))
    colors = ((model.sh[:, 0] * SH_C0 + 0.5).clamp(0, 1) * 255).to(torch.uint8)
    return Scene(
        name=f"tiny-{seed}",
        train=tuple(shot for i, shot in enumerate(shots) if i % 8),
        test=tuple(shots[::8]),
        points=model.means + 0.02 * torch.randn(model.means.shape, generator=generator),
        colors=colors,
    )
