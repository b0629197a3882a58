"""Extents of scenes."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from tiny_scenes import tiny_scene


def test_a_single_training_photo_has_an_extent_by_which_gaussians_can_move() -> None:
    scene = tiny_scene()
    alone = replace(scene, train=scene.train[:1])
    centre = torch.linalg.inv(alone.train[0].camera.viewmat.double())[:3, 3]
    points = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    seen = replace(alone, points=points, colors=torch.zeros(2, 3, dtype=torch.uint8))
    assert seen.extent == pytest.approx(1.1 * float(centre.norm()), rel=1e-5)
    assert replace(alone, points=points[:0]).extent > 0
