"""Projection and spherical harmonics against gsplat's own functions in torch, which run on the CPU.

gsplat's functions for the blending need a GPU or another package, so what gsplat projects is blended here.
"""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from gsplat.cuda._torch_impl import _fully_fused_projection, _quat_scale_to_covar_preci, _spherical_harmonics
from torch import Tensor

from keyss.rendering import rasterization
from rendering.scenes import Scene, around_the_camera, needles, random_scene


def project_by_gsplat(scene: Scene, leaves: dict[str, Tensor]) -> tuple[Tensor, ...]:
    """Radii, means2d, depths and conics of every camera."""
    covariances, _ = _quat_scale_to_covar_preci(leaves["quats"], leaves["scales"], True, False)
    found: tuple[Tensor, ...] = _fully_fused_projection(
        leaves["means"],
        covariances,
        scene.viewmats,
        scene.Ks,
        scene.width,
        scene.height,
        near_plane=scene.near_plane,
    )
    return found


@pytest.mark.parametrize(
    "build",
    [
        lambda: random_scene(count=500),
        around_the_camera,
        lambda: random_scene(cameras=2, size=0.02),
        needles,
    ],
    ids=["random", "around the camera", "two cameras", "needles"],
)
def test_projection(build: Callable[[], Scene]) -> None:
    scene = build()
    leaves = {name: leaf.detach() for name, leaf in scene.leaves(torch.float64).items()}
    radii, means2d, depths, _, _ = project_by_gsplat(scene, leaves)
    seen = (radii > 0).all(-1)
    assert seen.any()
    _, _, meta = scene.draw(scene.leaves())
    ours = meta["radii"]
    # The function draws radii at 3.33 standard deviations. gsplat's kernels in CUDA and ours go as far as
    # alpha reaches 1/255, which is less; therefore some at the border do not count as seen.
    drawn = (ours > 0).all(-1)
    assert not (drawn & ~seen).any()
    assert drawn.sum() >= 0.9 * seen.sum()
    assert (ours <= radii)[drawn].all()
    size = float(max(scene.width, scene.height))
    error = (meta["means2d"] - means2d)[drawn].abs() / means2d[drawn].abs().clamp_min(size)
    assert error.max() <= 1e-5
    torch.testing.assert_close(meta["depths"][drawn].double(), depths[drawn], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("degree", range(4))
def test_spherical_harmonics(degree: int) -> None:
    generator = torch.Generator().manual_seed(0)
    count = 10
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    coefficients = 0.3 * torch.randn(count, 16, 3, generator=generator)
    expected = (_spherical_harmonics(degree, directions, coefficients) + 0.5).clamp_min(0)
    for i, z in enumerate(directions):
        # One Gaussian in the middle of the picture: its colour is the pixel's, divided by alpha.
        x = torch.linalg.cross(torch.randn(3, generator=generator), z)
        x = x / x.norm()
        viewmat = torch.eye(4)
        viewmat[:3, :3] = torch.stack([x, torch.linalg.cross(z, x), z])
        images, alphas, _ = rasterization(
            3 * z[None],
            torch.tensor([[1.0, 0, 0, 0]]),
            torch.full((1, 3), 0.1),
            torch.tensor([0.9]),
            coefficients[i : i + 1],
            viewmat[None],
            torch.tensor([[[10.0, 0, 2.5], [0, 10, 2.5], [0, 0, 1]]]),
            5,
            5,
            sh_degree=degree,
        )
        torch.testing.assert_close(images[0, 2, 2] / alphas[0, 2, 2], expected[i], rtol=1e-5, atol=1e-5)
