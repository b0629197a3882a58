"""Cameras around models, and the scenes of their renders."""

from __future__ import annotations

import pytest
import torch

from keyss.core import camera_positions
from keyss.rendering import frame_of
from keyss.rendering.orbit import orbit, turntable
from rendering.test_framing import FLOORS, long_subject, on_a_floor
from tiny_scenes import random_gaussians

SIZE = 48


def test_orbit() -> None:
    model = random_gaussians(500)
    cameras = orbit(model, SIZE)
    frame = frame_of(model)
    middle, radius = torch.from_numpy(frame.middle).float(), frame.radius
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


def test_turntable_shows_all_of_an_object() -> None:
    model, filled = long_subject(300), []
    for camera in turntable(model, SIZE):
        x, y, z = (model.means @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]).T
        places = torch.stack([x, y]) / z * camera.K[0, 0] / (SIZE / 2)  # edges of the view at -1 and 1
        assert places.abs().max() < 1
        filled.append(float(places.max() - places.min()) / 2)
        assert places[1].max() + places[1].min() < 0.3  # as much room below as above
    assert max(filled) > 0.7


@pytest.mark.parametrize("up", ["-y", "z", "tilted"])
def test_turntable_goes_around_upright(up: str) -> None:
    model = on_a_floor(FLOORS[up])
    frame, cameras = frame_of(model), turntable(model, SIZE, 8)
    across = torch.from_numpy(frame.up).float()
    offsets = camera_positions(cameras) - torch.from_numpy(frame.middle).float()
    torch.testing.assert_close(offsets @ across, (offsets @ across).mean().expand(8), atol=1e-4, rtol=0)
    assert (offsets @ across > 0.2 * frame.radius).all()  # from a little above
    for camera in cameras:
        assert -camera.viewmat[1, :3] @ across > 0.9
    level = offsets - (offsets @ across)[:, None] * across
    assert level.mean(0).norm() < 0.2 * frame.radius  # all around
    reach = (level - level.mean(0)).norm(dim=1)
    torch.testing.assert_close(reach, reach.mean().expand(8), atol=1e-4, rtol=0)
