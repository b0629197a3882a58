"""Odd scenes, and inputs that do not affect the image."""

from __future__ import annotations

import math

import pytest
import torch

from keyss.rendering import rasterization
from rendering.scenes import random_scene

ATTRIBUTES = ("means", "quats", "scales", "opacities", "colors")


def test_non_finite_gaussians_are_skipped() -> None:
    scene = random_scene()
    leaves = {name: leaf.detach() for name, leaf in scene.leaves().items()}
    without = {name: leaf[1:] if name in ATTRIBUTES else leaf for name, leaf in leaves.items()}
    expected, _, _ = scene.draw(without)
    for spoiled in ATTRIBUTES:
        for value in (math.nan, math.inf, -math.inf):
            bad = {**leaves, spoiled: leaves[spoiled].clone()}
            bad[spoiled][0] = value
            images, _, meta = scene.draw(bad)
            assert torch.equal(images, expected)
            assert (meta["radii"][0, 0] == 0).all()


@pytest.mark.parametrize("count", [0, 3])
def test_empty_scene_is_background(count: int) -> None:
    means = torch.tensor([[0.0, 0.0, -5.0]]).repeat(count, 1).requires_grad_()
    background = torch.tensor([[0.1, 0.2, 0.3]], requires_grad=True)
    images, alphas, meta = rasterization(
        means,
        torch.zeros(count, 4),
        torch.ones(count, 3),
        torch.ones(count),
        torch.ones(count, 3),
        torch.eye(4)[None],
        torch.eye(3)[None],
        9,
        5,
        backgrounds=background,
    )
    assert (images == background[0]).all()
    assert (alphas == 0).all()
    images.sum().backward()
    assert meta["means2d"].grad.shape == (1, count, 2)
    assert means.grad is not None
    assert (means.grad == 0).all()
    assert background.grad is not None
    assert background.grad.tolist() == [[45.0, 45.0, 45.0]]
