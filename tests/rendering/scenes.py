"""Small scenes that between them reach every branch of the rasterizer."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass
class ToyScene:
    """The arguments of `rasterization` for one camera, in float64."""

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
    render_mode: str = "RGB"
    rasterize_mode: str = "classic"

    def tensors(self, dtype: torch.dtype) -> list[Tensor]:
        """Fresh leaves of the seven differentiable inputs."""
        inputs = (
            self.means, self.quats, self.scales, self.opacities, self.colors, self.viewmat, self.background,
        )  # fmt: skip
        return [tensor.to(dtype).detach().clone().requires_grad_() for tensor in inputs]


INPUT_NAMES = ("means", "quats", "scales", "opacities", "colors", "viewmat", "background")


def toy_scene(
    count: int = 60,
    width: int = 48,
    height: int = 40,
    *,
    sh_degree: int | None = 3,
    channels: int = 3,
    render_mode: str = "RGB",
    rasterize_mode: str = "classic",
    distance: float = 4.0,
    spread: float = 1.0,
    size: float = 0.1,
    seed: int = 0,
) -> ToyScene:
    """Random Gaussians before a slightly turned camera whose principal point is off centre."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    cosine, sine = math.cos(0.3), math.sin(0.3)
    viewmat = torch.tensor(
        [[cosine, 0, sine, 0.1], [0, 1, 0, -0.05], [-sine, 0, cosine, distance], [0, 0, 0, 1]],
        dtype=torch.float64,
    )
    K = torch.tensor(
        [[0.9 * width, 0, 0.52 * width], [0, 1.1 * height, 0.47 * height], [0, 0, 1]], dtype=torch.float64
    )
    scene = ToyScene(
        means=spread * normal(count, 3),
        quats=normal(count, 4),
        scales=size * (0.3 * normal(count, 3)).exp(),
        opacities=0.05 + 0.9 * uniform(count),
        colors=uniform(count, channels) if sh_degree is None else 0.3 * normal(count, 16, 3),
        viewmat=viewmat,
        K=K,
        width=width,
        height=height,
        background=uniform(channels),
        sh_degree=sh_degree,
        render_mode=render_mode,
        rasterize_mode=rasterize_mode,
    )
    # The nearest float32 numbers, so that both precisions see the same scene.
    for name in (*INPUT_NAMES, "K"):
        setattr(scene, name, getattr(scene, name).float().double())
    return scene


def opaque_wall() -> ToyScene:
    """Large, nearly opaque Gaussians: pixels stop early, and alphas reach the clamp."""
    scene = toy_scene(count=80, size=0.5, seed=1)
    scene.opacities = (0.9 + 0.0999 * torch.linspace(0, 1, 80)).double().float().double()
    return scene


def needles() -> ToyScene:
    """Long and thin, in all directions and along the rows: the exponential recurrence at its limit."""
    scene = toy_scene(count=60, width=70, height=80, seed=2)
    scene.scales = (torch.tensor([0.5, 0.001, 0.001]).double() * torch.ones(60, 1)).float().double()
    half_turns = torch.linspace(-0.3, 0.3, 30).double() / 2
    scene.quats[:30] = torch.stack([half_turns.cos(), 0 * half_turns, 0 * half_turns, half_turns.sin()], -1)
    scene.quats = scene.quats.float().double()
    return scene


def specks() -> ToyScene:
    """Much smaller than a pixel."""
    return toy_scene(count=200, size=1e-4, seed=3)


def around_the_camera(*, render_mode: str = "RGB", rasterize_mode: str = "classic") -> ToyScene:
    """Behind, across and just before the near plane, and far outside the image."""
    return toy_scene(
        count=150,
        distance=0.2,
        spread=1.5,
        size=0.15,
        seed=4,
        render_mode=render_mode,
        rasterize_mode=rasterize_mode,
    )


def antialiased_needles() -> ToyScene:
    """So thin that most are too faint to be drawn, and the gradient of the compensation is steep."""
    scene = needles()
    scene.rasterize_mode = "antialiased"
    scene.scales = (scene.scales * torch.tensor([1.0, 10.0, 10.0])).float().double()
    return scene


def opaque_wall_of_features() -> ToyScene:
    """Pixels that stop early, and alphas at the clamp, with many channels and the depth."""
    wall = opaque_wall()
    features = toy_scene(count=80, sh_degree=None, channels=5, render_mode="RGB+D")
    wall.colors, wall.background = features.colors, features.background
    wall.sh_degree, wall.render_mode = None, "RGB+D"
    return wall


SCENES: dict[str, Callable[[], ToyScene]] = {
    "random": toy_scene,
    "opaque wall": opaque_wall,
    "needles": needles,
    "specks": specks,
    "around the camera": around_the_camera,
    "one pixel": lambda: toy_scene(count=20, width=1, height=1, size=0.5, seed=5),
    "slim and tall": lambda: toy_scene(count=60, width=7, height=101, seed=6),
    "slim and wide": lambda: toy_scene(count=60, width=101, height=7, seed=7),
    "degree 0": lambda: toy_scene(sh_degree=0, seed=8),
    "degree 1": lambda: toy_scene(sh_degree=1, seed=9),
    "degree 2": lambda: toy_scene(sh_degree=2, seed=10),
    "rgb": lambda: toy_scene(sh_degree=None, seed=11),
    "one channel": lambda: toy_scene(sh_degree=None, channels=1, seed=12),
    "two channels and slim": lambda: toy_scene(width=7, height=101, sh_degree=None, channels=2, seed=13),
    "32 channels": lambda: toy_scene(sh_degree=None, channels=32, seed=14),
    "features and depth": opaque_wall_of_features,
    "depth": lambda: around_the_camera(render_mode="D"),
    "expected depth": lambda: toy_scene(render_mode="ED", seed=15),
    "colour and depth": lambda: toy_scene(render_mode="RGB+D", seed=16),
    "colour and expected depth": lambda: toy_scene(sh_degree=1, render_mode="RGB+ED", seed=17),
    "antialiased": lambda: toy_scene(size=0.03, rasterize_mode="antialiased", seed=18),
    "antialiased needles": antialiased_needles,
    "antialiased around the camera": lambda: around_the_camera(
        render_mode="RGB+ED", rasterize_mode="antialiased"
    ),
}
