"""Extents of scenes, and compensation of lost Gaussians."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from keyss.core import compensate_pruning
from tiny_scenes import random_gaussians, tiny_scene


def test_extent_of_single_photo() -> None:
    scene = tiny_scene()
    alone = replace(scene, train=scene.train[:1])
    points = alone.train[0].camera.position + 5 * torch.eye(3)
    assert replace(alone, points=points).extent == pytest.approx(5.5)
    assert replace(alone, points=points[:0]).extent > 0


def test_extent_of_photos_from_one_point() -> None:
    """Rounded positions of the cameras are no extent."""
    scene, centre = tiny_scene(), torch.tensor([0.3, -1.2, 2.1])
    train = []
    for view in scene.train:
        viewmat = view.camera.viewmat.clone()
        viewmat[:3, 3] = -viewmat[:3, :3] @ centre
        train.append(replace(view, camera=replace(view.camera, viewmat=viewmat)))
    around = replace(scene, train=tuple(train), points=centre + 5 * torch.cat([torch.eye(3), -torch.eye(3)]))
    assert around.extent == pytest.approx(5.5)


@pytest.mark.parametrize(("left", "count"), [(1000, 1000), (995, 1000), (10, 0)])
def test_small_losses_are_not_compensated(left: int, count: int) -> None:
    model = random_gaussians(left)
    assert compensate_pruning(model, count) is model


@pytest.mark.parametrize("share", [0.25, 0.5, 0.8])
def test_compensate_pruning(share: float) -> None:
    model = random_gaussians(200)
    found = compensate_pruning(model, round(200 / share))
    expected = 1 - (1 - model.opacities.double()) ** (1 / share)
    torch.testing.assert_close(found.opacities.double(), expected, rtol=0, atol=1e-5)
    torch.testing.assert_close(found.log_scales, model.log_scales + 0.25 * math.log(1 / share))
    assert (found.means is model.means, found.quats is model.quats, found.sh is model.sh) == (True,) * 3


@pytest.mark.parametrize("logit", [-80.0, 0.0, 80.0])
def test_compensation_stays_finite(logit: float) -> None:
    model = replace(random_gaussians(5), opacity_logits=torch.full((5,), logit))
    found = compensate_pruning(model, 10**9)
    assert found.opacity_logits.isfinite().all()
    assert found.log_scales.isfinite().all()
