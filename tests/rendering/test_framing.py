"""The subject of a model and its up direction, on models where both are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from keyss.core import Gaussians, Similarity
from keyss.rendering import frame_of
from tiny_scenes import random_gaussians

FLOORS = {"-y": [0.0, -1, 0], "z": [0, 0, 1], "y": [0, 1, 0], "tilted": [0.1, -0.84, -0.54]}


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


def subject(count: int = 3000, seed: int = 0) -> Gaussians:
    """Small opaque Gaussians in a ball around the origin."""
    model = random_gaussians(count, seed, 0)
    means = 0.6 * torch.nn.functional.normalize(model.means, dim=1) * torch.rand(count, 1).sqrt()
    return replace(
        model, means=means, log_scales=model.log_scales - 1.5, opacity_logits=torch.full((count,), 3.0)
    )


def fog(count: int = 4000, distance: float = 12.0, size: float = 15.0) -> Gaussians:
    """Coarse opaque Gaussians all around, many times as far away."""
    model = subject(count, 1)
    means = distance * (1 + torch.rand(count, 1)) * torch.nn.functional.normalize(model.means, dim=1)
    return replace(model, means=means, log_scales=model.log_scales + np.log(size))


def on_a_floor(up: list[float]) -> Gaussians:
    """The subject on a disc of flat Gaussians across `up`."""
    across, count = Similarity(1.0, _rotation(up), torch.zeros(3)), 2500
    disc, ball = subject(count, 2), subject(2500)
    angle, reach = 6.28 * torch.rand(count), 1.2 * torch.rand(count).sqrt()
    means = torch.stack([reach * angle.cos(), reach * angle.sin(), torch.full((count,), -0.6)], dim=1)
    scales = disc.log_scales.clone()
    scales[:, 2] -= 4
    flat = replace(
        disc, means=means, quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1), log_scales=scales
    )
    return across.apply_gaussians(Gaussians.cat([flat, ball]))


def _rotation(up: list[float]) -> torch.Tensor:
    """[3, 3] that maps z to `up`."""
    z = torch.nn.functional.normalize(torch.tensor(up, dtype=torch.float64), dim=0)
    x = torch.nn.functional.normalize(torch.linalg.cross(torch.tensor([0.3, 0.5, 0.8]).double(), z), dim=0)
    return torch.stack([x, torch.linalg.cross(z, x), z], dim=1)


@pytest.mark.parametrize(("distance", "size"), [(6.0, 15.0), (12.0, 15.0), (100.0, 15.0), (12.0, 1.4)])
def test_fog_is_ignored(distance: float, size: float) -> None:
    around = fog(distance=distance, size=size)
    alone, surrounded = frame_of(subject()), frame_of(Gaussians.cat([subject(), around]))
    assert np.linalg.norm(surrounded.middle - alone.middle) < 0.1
    assert 0.5 < surrounded.radius / alone.radius < 1.5


def long_subject(count: int) -> Gaussians:
    """The subject below a long thin neck of this many Gaussians."""
    neck = subject(count, 3)
    along = torch.linspace(0.6, 4, count)[:, None] * torch.tensor([0.0, -1, 0])
    return Gaussians.cat([subject(), replace(neck, means=0.1 * neck.means + along)])


def test_long_subject_is_whole() -> None:
    """A long object is not cut where most of its Gaussians are."""
    frame = frame_of(long_subject(600))
    assert (torch.from_numpy(frame.middle) - torch.tensor([0.0, -4, 0])).norm() < frame.radius + 0.1


@pytest.mark.parametrize("name", FLOORS)
def test_up_is_floor_normal(name: str) -> None:
    up = np.array(FLOORS[name]) / np.linalg.norm(FLOORS[name])
    assert frame_of(on_a_floor(FLOORS[name])).up @ up > np.cos(np.radians(6))


def test_up_without_floor() -> None:
    assert frame_of(subject()).up.tolist() == [0, -1, 0]


def test_wall_is_no_floor() -> None:
    """Captures begin in front of their subject: a wall is behind it, where the first camera looks."""
    wall = on_a_floor([0.0, 0, -1])  # which lies at z = 0.6
    assert frame_of(wall).up.tolist() == [0, -1, 0]


@pytest.mark.parametrize("share", [0.12, 0.3])
def test_small_floor_of_a_tilted_capture(share: float) -> None:
    up = np.array(FLOORS["tilted"]) / np.linalg.norm(FLOORS["tilted"])
    model = on_a_floor(FLOORS["tilted"])  # the floor, then the ball
    some = torch.cat([torch.arange(int(share * 2500)), torch.arange(2500, 5000)])
    assert frame_of(model[some]).up @ up > np.cos(np.radians(10))


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
def test_scale_and_place_do_not_matter(scale: float) -> None:
    model = Gaussians.cat([on_a_floor(FLOORS["z"]), fog()])
    moved = Similarity(scale, torch.eye(3), torch.tensor([3.0, -7, 2]).double() * scale)
    before, after = frame_of(model), frame_of(moved.apply_gaussians(model))
    assert np.allclose(after.middle, moved.apply_points(torch.from_numpy(before.middle)), atol=1e-3 * scale)
    assert after.radius == pytest.approx(scale * before.radius, rel=1e-3)
    assert np.allclose(after.up, before.up)


def test_degenerate_models_have_a_frame() -> None:
    one = subject(1)
    for model in (
        one,
        Gaussians.cat([one, one]),
        replace(subject(50), opacity_logits=torch.full((50,), -200.0)),
    ):
        frame = frame_of(model)
        assert np.isfinite(frame.middle).all()
        assert 0 < frame.radius < 10
        assert np.linalg.norm(frame.up) == pytest.approx(1)
