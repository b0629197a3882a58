"""Selections of Gaussians; extents of scenes."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
import torch

from keyss.core import Gaussians
from tiny_scenes import tiny_scene

COUNT = 7
CHOICES = [
    slice(1, 6, 2),
    slice(0, 0),
    torch.tensor([6, 0, 0, 3]),
    torch.tensor([5, 1], dtype=torch.int32),
    torch.tensor([True, False, True, True, False, False, True]),
    torch.zeros(COUNT, dtype=torch.bool),
    np.array([4, 2]),
]


@pytest.mark.parametrize("chosen", CHOICES, ids=str)
def test_selections_are_those_of_each_tensor(chosen: Any) -> None:
    shapes = ((COUNT, 3), (COUNT, 4), (COUNT, 3), (COUNT,), (COUNT, 4, 3))
    model = Gaussians(*(torch.randn(shape, requires_grad=True) for shape in shapes))
    selection = model[chosen]
    for field in fields(Gaussians):
        every, some = getattr(model, field.name), getattr(selection, field.name)
        assert some.equal(every[chosen])
        if len(selection):
            gradients = [torch.autograd.grad((part**3).sum(), every)[0] for part in (some, every[chosen])]
            assert gradients[0].equal(gradients[1])


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
