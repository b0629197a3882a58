"""Conventions of 3DGS against values computed by hand."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from keyss.core import SH_C0, Camera, Gaussians
from keyss.rendering import rasterization, render, render_with_meta


def draw(
    means: list[list[float]],
    opacities: list[float],
    colors: list[list[float]],
    scale: float = 0.01,
    background: list[float] | None = None,
    size: int = 9,
) -> tuple[Tensor, Tensor]:
    """Draw small round Gaussians with a camera at the origin looking along z, focal length 10."""
    count = len(means)
    image, alpha, _ = rasterization(
        torch.tensor(means, dtype=torch.float32),
        torch.tensor([[1.0, 0, 0, 0]]).expand(count, 4),
        torch.full((count, 3), scale),
        torch.tensor(opacities),
        torch.tensor(colors, dtype=torch.float32),
        torch.eye(4),
        torch.tensor([[10.0, 0, size / 2], [0, 10, size / 2], [0, 0, 1]]),
        size,
        size,
        background=None if background is None else torch.tensor(background, dtype=torch.float32),
    )
    return image, alpha


def test_pixel_centres() -> None:
    # The principal point 4.5 is the centre of pixel 4, where alpha is the opacity.
    image, alpha = draw([[0, 0, 1]], [0.5], [[1, 0.5, 0.25]])
    assert alpha[4, 4] == pytest.approx(0.5, abs=1e-6)
    assert image[4, 4].tolist() == pytest.approx([0.5, 0.25, 0.125], abs=1e-6)
    # The next pixel: variance (10 * 0.01)^2 + 0.3 pixels^2.
    assert alpha[4, 5] == pytest.approx(0.5 * math.exp(-0.5 / 0.31), abs=1e-6)
    assert alpha[5, 4] == alpha[4, 5] == alpha[3, 4] == alpha[4, 3]


def test_axes() -> None:
    _, alpha = draw([[0.2, 0.1, 1]], [0.5], [[1, 1, 1]])
    assert divmod(int(alpha.argmax()), 9) == (5, 6)


def test_transmittance_threshold() -> None:
    # The fourth Gaussian would leave less than 1e-4 and is not drawn.
    _, alpha = draw([[0, 0, 1.0 + i] for i in range(5)], [0.91] * 5, [[1, 1, 1]] * 5, scale=0.3)
    assert 1 - alpha[4, 4] == pytest.approx(0.09**3, rel=1e-3)


def test_colour() -> None:
    camera = Camera(torch.eye(4), torch.tensor([[10.0, 0, 4.5], [0, 10, 4.5], [0, 0, 1]]), 9, 9)
    dc = torch.tensor([[[1.0, -0.5, 4.0]]])
    gaussians = Gaussians(
        torch.tensor([[0.0, 0, 1]]),
        torch.tensor([[2.0, 0, 0, 0]]),
        torch.full((1, 3), -2.0),
        torch.tensor([3.0]),
        dc,
    )
    image, meta = render_with_meta(gaussians, camera)
    alpha = meta["alpha"]
    expected = (0.5 + SH_C0 * dc[0, 0]).tolist()
    assert (image[4, 4] / alpha[4, 4]).tolist() == pytest.approx(expected, abs=1e-6)
    assert image.max() > 1
    assert alpha[4, 4] == pytest.approx(torch.tensor(3.0).sigmoid().item(), abs=1e-6)
    assert torch.equal(render(gaussians, camera), image)
    white = render(gaussians, camera, torch.ones(3))
    torch.testing.assert_close(white, image + (1 - alpha)[..., None])
    below = Gaussians(*(getattr(gaussians, name) for name in ("means", "quats", "log_scales")),
                      gaussians.opacity_logits, -dc * 10)  # fmt: skip
    assert render(below, camera)[4, 4, 0] == 0
