"""Cameras around models, and the scenes of their renders."""

from __future__ import annotations

from dataclasses import replace

import torch

from keyss.core import Gaussians, camera_positions
from keyss.rendering import middle_and_radius
from keyss.rendering.orbit import orbit
from tiny_scenes import random_gaussians

SIZE = 48


def test_orbit() -> None:
    model = random_gaussians(500)
    cameras = orbit(model, SIZE)
    middle, radius = middle_and_radius(model)
    outward = torch.nn.functional.normalize(camera_positions(cameras) - middle, dim=1)
    for camera, direction in zip(cameras, outward, strict=True):
        torch.testing.assert_close(camera.viewmat[2, :3], -direction, atol=1e-5, rtol=0)
        assert camera.viewmat[1, 1] > 0
        rotation = camera.viewmat[:3, :3].double()
        torch.testing.assert_close(rotation @ rotation.T, torch.eye(3).double(), atol=1e-6, rtol=0)
        assert torch.det(rotation) > 0
    sides = torch.cat([torch.eye(3)[[0, 2]], -torch.eye(3)[[0, 2]]])
    assert ((outward @ sides.T) > 0.7).any(0).all()
    assert (camera_positions(cameras) - middle).norm(dim=1).min() > radius


def test_faint_and_distant_gaussians_are_ignored() -> None:
    model = random_gaussians(500)
    middle, radius = middle_and_radius(model)
    far = replace(model[:20], means=model[:20].means * 1000 + 500)
    faint = replace(model[:100], means=model[:100].means + 50, opacity_logits=torch.full((100,), -12.0))
    moved, larger = middle_and_radius(Gaussians.cat([model, far, faint]))
    assert float((moved - middle).norm()) < 0.2 * radius
    assert larger < 1.3 * radius
