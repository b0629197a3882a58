"""Small scenes that cover every branch of the rasterizer."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from keyss.rendering import rasterization

DIFFERENTIABLE = ("means", "quats", "scales", "opacities", "colors", "background")
CAMERA = ("viewmat", "K")


@dataclass
class Scene:
    """Arguments of `rasterization` in float64, rounded to float32 so that both precisions agree."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor  # [N, 16, 3], or [N, D] where sh_degree is None
    viewmat: Tensor
    K: Tensor
    width: int
    height: int
    background: Tensor
    sh_degree: int | None
    near_plane: float = 2.0**-6  # exact in float32

    def __post_init__(self) -> None:
        self.round()

    def round(self) -> None:
        for name in (*DIFFERENTIABLE, *CAMERA):
            setattr(self, name, getattr(self, name).float().double())

    def leaves(self, dtype: torch.dtype = torch.float32) -> dict[str, Tensor]:
        """Copies of the differentiable inputs that require gradients."""
        return {name: getattr(self, name).to(dtype).clone().requires_grad_() for name in DIFFERENTIABLE}

    def settings(self) -> dict[str, Any]:
        """Keyword arguments other than tensors."""
        names = ("width", "height", "sh_degree", "near_plane")
        return {name: getattr(self, name) for name in names}

    def draw(self, leaves: dict[str, Tensor], **changes: Any) -> tuple[Tensor, Tensor, dict[str, Any]]:
        camera = {name: getattr(self, name).to(leaves["means"]) for name in CAMERA}
        return rasterization(**{**camera, **leaves, **self.settings(), **changes})

    def results(self, leaves: dict[str, Tensor] | None = None, **changes: Any) -> dict[str, Tensor]:
        """Image, alpha, meta and the gradients of a random loss."""
        leaves = self.leaves() if leaves is None else leaves
        image, alpha, meta = self.draw(leaves, **changes)
        meta["means2d"].retain_grad()
        torch.autograd.backward([image, alpha], [each.to(image) for each in self.weights()])
        found = {"image": image, "alpha": alpha, "radii": meta["radii"], "depths": meta["depths"]}
        found["means2d"] = meta["means2d"]
        found["gradient of means2d"] = meta["means2d"].grad
        for name in DIFFERENTIABLE:
            leaf = leaves[name]
            found[f"gradient of {name}"] = torch.zeros_like(leaf) if leaf.grad is None else leaf.grad
        return {name: tensor.detach() for name, tensor in found.items()}

    def weights(self) -> tuple[Tensor, Tensor]:
        """Of the image and alpha in a random loss."""
        generator = torch.Generator().manual_seed(99)
        shape = (self.height, self.width)
        return tuple(torch.randn(*shape, *last, generator=generator) for last in (self.background.shape, ()))  # type: ignore[return-value]

    def dense_arguments(self, leaves: dict[str, Tensor]) -> dict[str, Any]:
        """Arguments of `dense_rasterization`."""
        return {**leaves, **self.settings(), "viewmat": self.viewmat, "K": self.K}


def random_scene(
    count: int = 60,
    width: int = 48,
    height: int = 40,
    *,
    sh_degree: int | None = 3,
    channels: int = 3,
    distance: float = 4.0,
    spread: float = 1.0,
    size: float = 0.1,
    seed: int = 0,
) -> Scene:
    """Random Gaussians before a slightly rotated camera with an off-centre principal point."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    cosine, sine = math.cos(0.3), math.sin(0.3)
    viewmat = [[cosine, 0, sine, 0.1], [0, 1, 0, -0.05], [-sine, 0, cosine, distance], [0, 0, 0, 1]]
    K = [[0.9 * width, 0, 0.52 * width], [0, 1.1 * height, 0.47 * height], [0, 0, 1]]
    return Scene(
        means=spread * normal(count, 3),
        quats=normal(count, 4),
        scales=size * (0.3 * normal(count, 3)).exp(),
        opacities=0.05 + 0.9 * uniform(count),
        colors=uniform(count, channels) if sh_degree is None else 0.3 * normal(count, 16, 3),
        viewmat=torch.tensor(viewmat, dtype=torch.float64),
        K=torch.tensor(K, dtype=torch.float64),
        width=width,
        height=height,
        background=uniform(channels),
        sh_degree=sh_degree,
    )


def opaque_walls() -> Scene:
    """Large, nearly opaque Gaussians: pixels stop early, and alphas reach the clamp."""
    scene = random_scene(count=80, size=0.5, seed=1)
    return replace(scene, opacities=0.9 + 0.1 * torch.linspace(0, 1, 80))


def opaque_walls_of_features() -> Scene:
    """Pixels that stop early, and alphas at the clamp, with many channels."""
    features = random_scene(count=80, sh_degree=None, channels=5)
    return replace(opaque_walls(), colors=features.colors, background=features.background, sh_degree=None)


def coincident(**changes: Any) -> Scene:
    """10,000 Gaussians at one place, faint enough that thousands contribute to each pixel."""
    scene = random_scene(count=10_000, width=6, height=5, size=0.5, seed=20, **changes)
    return replace(
        scene, means=scene.means[:1].expand(10_000, 3) * 0.1, opacities=0.0042 + 0.003 * scene.opacities
    )


def needles() -> Scene:
    """Long and thin, along the rows too: the limit of the exponential recurrence."""
    scene = random_scene(count=60, width=70, height=80, seed=2)
    half_turns = torch.linspace(-0.3, 0.3, 30).double() / 2
    scene.quats[:30] = torch.stack([half_turns.cos(), 0 * half_turns, 0 * half_turns, half_turns.sin()], -1)
    return replace(scene, scales=torch.tensor([0.5, 0.001, 0.001]).expand(60, 3))


def specks() -> Scene:
    """Much smaller than a pixel."""
    return random_scene(count=200, size=1e-4, seed=3)


def around_the_camera(**changes: Any) -> Scene:
    """On all sides of the camera, and far outside the image."""
    return random_scene(count=150, distance=0.2, spread=1.5, size=0.15, seed=4, **changes)


def around_the_near_plane() -> Scene:
    """Behind the camera, behind the near plane, exactly on it, across it, and beyond."""
    scene = random_scene(count=50, size=0.1, spread=0.4, seed=21)
    near = 0.25
    means = scene.means.clone()
    means[:, 2] = torch.cat(
        [
            torch.linspace(-2, -0.01, 10),  # behind the camera
            torch.linspace(0.01, 0.24, 10),  # before the near plane, not drawn
            torch.full((10,), near),  # on the near plane, drawn
            near * (1 + torch.tensor([-0.1, -1e-3, -1e-4, 1e-4, 1e-3, 0.01, 0.02, 0.05, 0.1, 0.2])),
            torch.linspace(0.3, 3, 10),
        ]
    )
    # Depths are exact along the z axis.
    return replace(scene, means=means, viewmat=torch.eye(4), near_plane=near)


SCENES: dict[str, Callable[[], Scene]] = {
    "random": random_scene,
    "opaque walls": opaque_walls,
    "opaque walls of features": opaque_walls_of_features,
    "10,000 coincident": coincident,
    "around the camera": around_the_camera,
    "around the near plane": around_the_near_plane,
    "needles": needles,
    "specks": specks,
    "one pixel": lambda: random_scene(count=20, width=1, height=1, size=0.5, seed=5),
    "7 x 1013 pixels": lambda: random_scene(count=60, width=7, height=1013, seed=6),
    "101 x 7 pixels": lambda: random_scene(count=60, width=101, height=7, seed=7),
    "degree 0": lambda: random_scene(sh_degree=0, seed=8),
    "degree 1": lambda: random_scene(sh_degree=1, seed=9),
    "degree 2": lambda: random_scene(sh_degree=2, seed=10),
    "3 channels": lambda: random_scene(sh_degree=None, seed=11),
    "1 channel": lambda: random_scene(sh_degree=None, channels=1, seed=12),
    "2 channels, 7 x 101 pixels": lambda: random_scene(
        width=7, height=101, sh_degree=None, channels=2, seed=13
    ),
    "5 channels": lambda: random_scene(sh_degree=None, channels=5, seed=19),
    "32 channels": lambda: random_scene(sh_degree=None, channels=32, seed=14),
}
