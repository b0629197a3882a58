"""Projection and spherical harmonics against gsplat's own functions in torch, which run on the CPU."""

from __future__ import annotations

import torch
from gsplat.cuda._torch_impl import (
    _fully_fused_projection,
    _quat_scale_to_covar_preci,
    _spherical_harmonics,
)

from keyss.rendering import rasterization
from keyss.rendering.cpu import layout, projection
from keyss.rendering.cpu.parallel import run
from keyss.rendering.cpu.rasterization import _camera_array
from rendering.toy_scenes import around_the_camera, toy_scene


def test_projection() -> None:
    for scene in (toy_scene(count=500), around_the_camera()):
        means, quats, scales, _, _, viewmat, _ = (t.detach() for t in scene.tensors(torch.float32))
        K, count = scene.K.float(), len(means)
        covariances, _ = _quat_scale_to_covar_preci(quats.double(), scales.double(), True, False)
        radii, means2d, depths, conics, compensations = _fully_fused_projection(
            means.double(),
            covariances,
            viewmat[None].double(),
            K[None].double(),
            scene.width,
            scene.height,
            calc_compensations=True,
        )
        footprints = torch.zeros(count, layout.DECAY + 1)
        our_means2d, our_depths = torch.zeros(count, 2), torch.zeros(count)
        our_radii = torch.zeros(count, 2, dtype=torch.int32)
        run(
            projection.project,
            means.numpy(),
            quats.numpy(),
            scales.numpy(),
            torch.ones(count).numpy(),
            _camera_array(viewmat, K),
            scene.width,
            scene.height,
            layout.f32(0.01),
            layout.f32(1e10),
            layout.f32(0.3),
            layout.ZERO,
            True,
            footprints.numpy(),
            our_means2d.numpy(),
            our_depths.numpy(),
            our_radii.numpy(),
        )
        # Where nothing is left of the opacity, which is 1 here, ours draws nothing.
        seen = (radii[0] > 0).all(-1) & (compensations[0] > 1 / 255)
        assert seen.any()
        assert torch.equal(seen, (our_radii > 0).all(-1))
        # gsplat's CUDA kernels, like ours, use sqrt(2 ln 255) = 3.329 where this function uses 3.33.
        assert (our_radii - radii[0])[seen].abs().max() <= 1
        torch.testing.assert_close(our_means2d[seen].double(), means2d[0][seen], rtol=1e-5, atol=1e-4)
        torch.testing.assert_close(our_depths[seen].double(), depths[0][seen], rtol=1e-5, atol=1e-6)
        exponent = footprints[:, [layout.XX, layout.XY, layout.YY]].double()
        our_conics = -exponent * torch.tensor([2.0, 1.0, 2.0])
        error = (our_conics - conics[0])[seen].norm(dim=1) / conics[0][seen].norm(dim=1)
        assert error.max() < 1e-5
        ours = footprints[:, layout.OPACITY].double()
        torch.testing.assert_close(ours[seen], compensations[0][seen], rtol=1e-5, atol=1e-6)


def test_spherical_harmonics() -> None:
    generator = torch.Generator().manual_seed(0)
    count = 50
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    coefficients = 0.3 * torch.randn(count, 16, 3, generator=generator)
    for degree in range(4):
        expected = (_spherical_harmonics(degree, directions, coefficients) + 0.5).clamp_min(0)
        for i in range(0, count, 10):
            z = directions[i]
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
