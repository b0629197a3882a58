"""PSNR against its definition, and the choice of evaluated views."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from keyss.core import View
from keyss.fitting import psnr, quality, subsample_views
from tiny_scenes import random_gaussians, ring_cameras, tiny_scene


def test_psnr_is_what_its_definition_says() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.uniform(-0.5, 1.5, (2, 7, 5, 3))
    error = np.mean((a.clip(0, 1) - b.clip(0, 1)) ** 2)
    assert psnr(torch.from_numpy(a), torch.from_numpy(b)) == pytest.approx(-10 * np.log10(error))
    assert psnr(torch.from_numpy(a), torch.from_numpy(a)) == pytest.approx(120)  # instead of infinity


def test_photos_of_a_model_are_as_near_to_it_as_bytes_allow() -> None:
    scene = tiny_scene(3)
    own = quality(random_gaussians(seed=3), scene.test, scene.background)
    other = quality(random_gaussians(seed=4), scene.test, scene.background)
    assert own.psnr > 55
    assert own.ssim > 0.999
    assert other.psnr < 30
    assert other.ssim < 0.9


@pytest.mark.parametrize(
    ("count", "most", "indices"),
    [(10, 3, [0, 4, 8]), (10, 5, [0, 2, 4, 6, 8]), (3, 8, [0, 1, 2]), (9, 1, [0])],
)
def test_views_are_subsampled_evenly(count: int, most: int, indices: list[int]) -> None:
    views = [View(camera, torch.empty(0)) for camera in ring_cameras(count)]
    chosen = [view.camera.name for view in subsample_views(views, most)]
    assert chosen == [f"{index:03d}.png" for index in indices]
