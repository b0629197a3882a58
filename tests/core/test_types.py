"""Extents of scenes."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from tiny_scenes import tiny_scene


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
