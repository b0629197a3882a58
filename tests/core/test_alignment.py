"""Alignment of scenes by their cameras."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st
from torch import Tensor

from core.test_similarity import random_similarity
from keyss.core import Camera, align, camera_positions, focus_point, up_direction


def looking_at(position: np.ndarray, target: np.ndarray, up: np.ndarray) -> Camera:
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    viewmat = np.eye(4)
    viewmat[:3, :3] = [right, np.cross(forward, right), forward]
    viewmat[:3, 3] = -viewmat[:3, :3] @ position
    return Camera(torch.from_numpy(viewmat).float(), torch.eye(3), 8, 8)


def ring(seed: int, turn: float, count: int = 30, height: float = 0.6, target: float = 0.0) -> list[Camera]:
    """Cameras at radius 3 over `turn` radians, z up, looking roughly at `target` on the z axis."""
    rng = np.random.default_rng(seed)
    cameras = []
    for i in range(count):
        angle, radius = turn * i / count, 3 * (1 + 0.2 * rng.normal())
        position = np.array(
            [radius * math.cos(angle), radius * math.sin(angle), 3 * height + 0.2 * rng.normal()]
        )
        wobble = 0.1 * rng.normal(size=3)
        cameras.append(looking_at(position, wobble + np.array([0, 0, target]), np.array([0.0, 0.0, 1.0])))
    return cameras


def mean_distance(cameras: list[Camera]) -> float:
    return float((camera_positions(cameras).double() - focus_point(cameras)).norm(dim=1).mean())


def heading(cameras: list[Camera], up: Tensor) -> Tensor:
    mean = torch.stack([camera.viewmat[2, :3] for camera in cameras]).double().mean(0)
    across = mean - up * (up @ mean)
    return across / across.norm()


seeds = st.integers(0, 10_000)
quick = settings(max_examples=25, deadline=None)


@quick
@given(seeds)
def test_align_recovers_similarity(seed: int) -> None:
    cameras, moved_by = ring(seed, math.pi), random_similarity(seed)
    found = align([moved_by.apply_camera(camera) for camera in cameras], cameras)
    assert found.scale * moved_by.scale == pytest.approx(1, abs=1e-4)
    rotation, origin = found.rotation @ moved_by.rotation, found.apply_points(moved_by.translation)
    torch.testing.assert_close(rotation, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-4)
    torch.testing.assert_close(origin, torch.zeros(3, dtype=torch.float64), rtol=0, atol=1e-3)


@quick
@given(seeds, st.sampled_from([math.pi, 1.5, 2 * math.pi]), st.sampled_from([math.pi, 2 * math.pi]))
def test_align_matches_focus_distance_and_up(seed: int, secret_turn: float, cover_turn: float) -> None:
    world = random_similarity(seed)
    secret = [world.apply_camera(camera) for camera in ring(seed, secret_turn, height=0.3)]
    cover = ring(seed + 1, cover_turn, height=0.8)
    similarity = align(secret, cover)
    moved = [similarity.apply_camera(camera) for camera in secret]
    torch.testing.assert_close(focus_point(moved), focus_point(cover), rtol=0, atol=1e-3)
    assert mean_distance(moved) == pytest.approx(mean_distance(cover), rel=1e-3)
    up = up_direction(cover)
    torch.testing.assert_close(up_direction(moved), up, rtol=0, atol=1e-4)
    if 2 * math.pi not in (secret_turn, cover_turn):
        torch.testing.assert_close(heading(moved, up), heading(cover, up), rtol=0, atol=1e-4)


@pytest.mark.parametrize("turn", [1.5, math.pi, 2 * math.pi])
def test_up_direction_of_partial_ring(turn: float) -> None:
    """The mean of the cameras' up vectors would lean."""
    up = up_direction(ring(0, turn, height=1.0))
    assert up[2] > 0.999
