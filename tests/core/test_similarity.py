"""Similarity transforms of cameras and Gaussians."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from gsplat.cuda._torch_impl import _eval_sh_bases_fast
from hypothesis import given, settings, strategies as st
from scipy.spatial.transform import Rotation
from torch import Tensor

from keyss.core import Camera, Gaussians, Similarity
from tiny_scenes import random_gaussians


def random_similarity(seed: int) -> Similarity:
    rng = np.random.default_rng(seed)
    rotation = torch.from_numpy(Rotation.random(None, rng).as_matrix())
    return Similarity(float(np.exp(rng.normal())), rotation, torch.from_numpy(rng.normal(size=3)))


def random_camera(seed: int) -> Camera:
    rng = np.random.default_rng(seed)
    viewmat = torch.eye(4)
    viewmat[:3, :3] = torch.from_numpy(Rotation.random(None, rng).as_matrix())
    viewmat[:3, 3] = torch.from_numpy(rng.normal(size=3))
    return Camera(viewmat, torch.tensor([[80.0, 0, 32], [0, 90, 24], [0, 0, 1]]), 64, 48, "a")


def covariances(gaussians: Gaussians) -> Tensor:
    """[N, 3, 3] float64."""
    w, x, y, z = gaussians.quats.double().unbind(-1)
    turns = torch.from_numpy(Rotation.from_quat(torch.stack([x, y, z, w], -1).numpy()).as_matrix())
    axes = turns * gaussians.scales.double()[:, None, :]
    return axes @ axes.transpose(1, 2)


seeds = st.integers(0, 10_000)
quick = settings(max_examples=40, deadline=None)


@quick
@given(seeds)
def test_cameras(seed: int) -> None:
    similarity, camera = random_similarity(seed), random_camera(seed)
    points = torch.randn(10, 3, generator=torch.Generator().manual_seed(seed))

    def seen(camera: Camera, points: Tensor) -> Tensor:
        return points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]

    moved = similarity.apply_camera(camera)
    expected = similarity.scale * seen(camera, points)
    torch.testing.assert_close(seen(moved, similarity.apply_points(points)), expected, rtol=1e-4, atol=1e-4)
    rigid = moved.viewmat[:3, :3]
    torch.testing.assert_close(rigid @ rigid.T, torch.eye(3), rtol=0, atol=1e-6)
    torch.testing.assert_close(moved.position, similarity.apply_points(camera.position), rtol=1e-4, atol=1e-4)
    assert (moved.width, moved.height, moved.name) == (camera.width, camera.height, camera.name)
    assert moved.viewmat.dtype == torch.float32


@quick
@given(seeds)
def test_gaussians(seed: int) -> None:
    similarity, gaussians = random_similarity(seed), random_gaussians(20, seed)
    moved = similarity.apply_gaussians(gaussians)
    turn = similarity.rotation
    expected = similarity.scale**2 * turn @ covariances(gaussians) @ turn.T
    torch.testing.assert_close(covariances(moved), expected, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(moved.quats.norm(dim=1), gaussians.quats.norm(dim=1))
    assert torch.equal(moved.opacity_logits, gaussians.opacity_logits)
    assert {getattr(moved, name).dtype for name in ("means", "quats", "log_scales", "sh")} == {torch.float32}


@quick
@given(seeds, st.integers(0, 3))
def test_harmonics(seed: int, degree: int) -> None:
    similarity, gaussians = random_similarity(seed), random_gaussians(20, seed, degree)
    directions = torch.nn.functional.normalize(torch.randn(30, 3, dtype=torch.float64), dim=1)
    k = (degree + 1) ** 2
    before = _eval_sh_bases_fast(k, directions @ similarity.rotation) @ gaussians.sh.double()
    after = _eval_sh_bases_fast(k, directions) @ similarity.apply_gaussians(gaussians).sh.double()
    torch.testing.assert_close(after, before, rtol=0, atol=3e-6)


@pytest.mark.parametrize(
    ("scale", "rotation"),
    [
        (0.0, torch.eye(3)),
        (-1.0, torch.eye(3)),
        (math.inf, torch.eye(3)),
        (1.0, torch.diag(torch.tensor([1.0, 1.0, -1.0]))),
        (1.0, torch.diag(torch.tensor([1.0, 1.0, 1.00001]))),
        (1.0, torch.diag(torch.tensor([1.0, 1.0, math.nan]))),
    ],
)
def test_invalid_similarities(scale: float, rotation: Tensor) -> None:
    with pytest.raises(ValueError, match="similarity: "):
        Similarity(scale, rotation.double())
