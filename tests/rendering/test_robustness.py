"""Odd scenes, and inputs that do not affect the image."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from keyss.rendering import rasterization
from keyss.rendering.cpu import memory, rasterization as cpu_rasterization
from rendering.scenes import DIFFERENTIABLE, random_scene

ATTRIBUTES = ("means", "quats", "scales", "opacities", "colors")


def test_one_bad_gaussian_leaves_the_rest_of_the_picture_as_it_was() -> None:
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


@pytest.mark.parametrize("channels", [3, 5])
def test_colours_of_a_trillion_are_not_drawn(channels: int) -> None:
    # Their gradients would overflow.
    scene = random_scene(sh_degree=None, channels=channels)
    expected = scene.results()
    scene.colors[7, 1] = 1e12
    results = scene.results()
    assert (results["radii"][0, 7] == 0).all()
    scene.colors[7, 1] = 0.9e12
    results = scene.results()
    assert torch.equal(results["radii"], expected["radii"])
    assert all(tensor.isfinite().all() for tensor in results.values())


@pytest.mark.parametrize("count", [0, 3])
def test_nothing_to_see_is_the_background(count: int) -> None:
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


def test_without_cameras_there_are_no_images_and_all_gradients_are_zero() -> None:
    scene = random_scene(count=3000, cameras=0)
    for floats in (3000, 9000, 12000, 144000):  # what the memory holds of which gradients may be made
        memory.empty((floats,), np.float32)[:] = math.nan
    results = scene.results()
    assert results["images"].shape == (0, scene.height, scene.width, 3)
    for name in DIFFERENTIABLE:
        assert (results[f"gradient of {name}"] == 0).all(), name


def test_only_wanted_gradients_are_made() -> None:
    scene = random_scene()
    for wanted in DIFFERENTIABLE:
        leaves = {name: leaf.requires_grad_(name == wanted) for name, leaf in scene.leaves().items()}
        images, _, meta = scene.draw(leaves)
        images.sum().backward()
        assert [name for name, leaf in leaves.items() if leaf.grad is not None] == [wanted]
        assert meta["means2d"].requires_grad == (wanted not in ("colors", "backgrounds"))
    with torch.no_grad():
        images, _, meta = scene.draw(scene.leaves())
    assert not images.requires_grad
    assert not meta["means2d"].requires_grad


def test_alpha_alone_has_gradients() -> None:
    scene = random_scene()
    leaves = scene.leaves()
    _, alphas, _ = scene.draw(leaves)
    alphas.sum().backward()
    assert leaves["opacities"].grad is not None
    assert (leaves["opacities"].grad > 0).any()
    assert leaves["colors"].grad is not None
    assert (leaves["colors"].grad == 0).all()


def test_too_many_tiles_are_an_error_not_a_crash(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cpu_rasterization, "MAX_PAIRS", 3)
    scene = random_scene()
    with pytest.raises(cpu_rasterization.BackendError, match="tiles together"):
        scene.draw(scene.leaves())
