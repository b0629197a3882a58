"""A stand-in for gsplat's CUDA module, based on its reference implementation `gsplat.cuda._torch_impl`.

The rest of gsplat runs unchanged: `rasterization` and its autograd Functions. As in CUDA, tensors must be
contiguous and float32 (`CHECK_INPUT` and `data_ptr<float>`). Values that CUDA leaves uninitialised are NaN.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import wraps
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from gsplat.cuda import _torch_impl as reference
from torch import Tensor

from rendering.fake_cuda import GpuTensor, as_cpu

ALPHA_MIN, TRANSMITTANCE_MIN, ALPHA_MAX = 1 / 255, 1e-4, 0.999  # in CUDA's kernels
NAN = math.nan


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Make a function take and return GPU tensors."""

    @wraps(function)
    def launch(*arguments: Any) -> Any:
        with torch._C.DisableTorchFunction():
            for argument in arguments:
                if isinstance(argument, Tensor):
                    assert isinstance(argument, GpuTensor) or torch._C._current_graph_task_id() != -1, (
                        "on the CPU"
                    )
                    assert argument.is_contiguous()
                    assert not argument.is_floating_point() or argument.dtype == torch.float32, argument.dtype
            results = function(
                *(as_cpu(argument) if isinstance(argument, Tensor) else argument for argument in arguments)
            )
            if isinstance(results, Tensor):
                return results.as_subclass(GpuTensor)
            return tuple(
                result.as_subclass(GpuTensor) if isinstance(result, Tensor) else result for result in results
            )

    return launch


def project(
    means: Tensor, quats: Tensor, scales: Tensor, *camera: Any, **planes: float
) -> tuple[Tensor, ...]:
    covariances, _ = reference._quat_scale_to_covar_preci(quats, scales, True, False)
    found: tuple[Tensor, ...] = reference._fully_fused_projection(means, covariances, *camera, **planes)
    return found


@kernel
def projection_ewa_3dgs_fused_fwd(
    means: Tensor, covars: None, quats: Tensor, scales: Tensor, opacities: Tensor, viewmats: Tensor,
    Ks: Tensor, width: int, height: int, eps2d: float, near: float, far: float, radius_clip: float,
    compensate: bool, camera_model: str,
) -> tuple[Tensor | None, ...]:  # fmt: skip
    assert (covars, radius_clip, compensate, camera_model) == (None, 0.0, False, "pinhole")
    # Unlike the reference, the kernels draw Gaussians on the near plane.
    planes = {"near_plane": float(np.nextafter(np.float32(near), np.float32(0))), "far_plane": far}
    radii, means2d, depths, conics, _ = project(
        means, quats, scales, viewmats, Ks, width, height, eps2d, **planes
    )
    # The kernels' radii depend on the opacity; the reference always uses 3.33 standard deviations.
    reach = (2 * (opacities / ALPHA_MIN).log()).sqrt().nan_to_num(0).clamp_max(3.33)
    variances = torch.stack([conics[..., 2], conics[..., 0]], -1)
    variances = variances / (conics[..., 0] * conics[..., 2] - conics[..., 1] ** 2)[..., None]
    own = (reach[:, None] * variances.sqrt()).ceil()
    size = means2d.new_tensor([width, height])
    inside = ((means2d + own > 0) & (means2d - own < size)).all(-1, keepdim=True)
    radii = torch.where((radii > 0).all(-1, keepdim=True) & inside, own, 0).int()
    hidden = ~(radii > 0).all(-1)
    for each in (means2d, depths, conics):
        each[hidden] = NAN
    return radii, means2d, depths, conics, None


@kernel
def projection_ewa_3dgs_fused_bwd(
    means: Tensor, covars: None, quats: Tensor, scales: Tensor, viewmats: Tensor, Ks: Tensor, width: int,
    height: int, eps2d: float, camera_model: str, radii: Tensor, conics: Tensor, compensations: None,
    v_means2d: Tensor, v_depths: Tensor, v_conics: Tensor, v_compensations: None, viewmats_too: bool,
) -> tuple[Tensor | None, ...]:  # fmt: skip
    assert not viewmats_too
    totals = [torch.zeros_like(each) for each in (means, quats, scales)]
    (seen,) = (radii[0] > 0).all(-1).nonzero(as_tuple=True)
    gradients = pullback(
        lambda *leaves: project(*leaves, viewmats, Ks, width, height, eps2d)[1:4],
        [each[seen] for each in (means, quats, scales)],
        [each[:, seen] for each in (v_means2d, v_depths, v_conics)],
    )
    for total, gradient in zip(totals, gradients, strict=True):
        total[seen] = gradient
    return totals[0], None, totals[1], totals[2], None


@kernel
def spherical_harmonics_fwd(degree: int, directions: Tensor, coefficients: Tensor, masks: Tensor) -> Tensor:
    colors: Tensor = reference._spherical_harmonics(degree, directions, coefficients)
    colors[~masks] = NAN
    return colors


@kernel
def spherical_harmonics_bwd(
    bases: int, degree: int, directions: Tensor, coefficients: Tensor, masks: Tensor, v_colors: Tensor,
    directions_too: bool,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    assert bases == coefficients.shape[-2]
    found = torch.zeros_like(coefficients), torch.zeros_like(directions)
    found[0][masks], found[1][masks] = pullback(
        lambda k, d: (reference._spherical_harmonics(degree, d, k),),
        [coefficients[masks], directions[masks]],
        [v_colors[masks]],
    )
    return found


@kernel
def intersect_tile(
    means2d: Tensor, radii: Tensor, depths: Tensor, images: None, gaussians: None, count: int, size: int,
    columns: int, rows: int, sort: bool, segmented: bool,
) -> tuple[Tensor, ...]:  # fmt: skip
    """Vectorised `reference._isect_tiles`, which is too slow for trainings."""
    assert sort
    count_of_tiles = means2d.new_tensor([columns, rows])
    low = ((means2d - radii) / size).floor().nan_to_num(0).clamp_min(0).minimum(count_of_tiles).int()
    high = ((means2d + radii) / size).ceil().nan_to_num(0).clamp_min(0).minimum(count_of_tiles).int()
    spans = (high - low) * (radii > 0).all(-1, keepdim=True)
    counts = spans.prod(-1, dtype=torch.int32)
    ids = torch.arange(counts.numel()).repeat_interleave(counts.flatten())
    within = torch.arange(len(ids)) - (counts.flatten().cumsum(0) - counts.flatten())[ids]
    widths, starts = spans[..., 0].flatten()[ids], low.reshape(-1, 2)[ids]
    tiles = (starts[:, 1] + within // widths) * columns + starts[:, 0] + within % widths
    keys = (tiles << 32) | depths.flatten()[ids].view(torch.int32)
    keys, order = keys.sort(stable=True)  # as CUB's sort is
    return counts, keys, ids[order].int()


@kernel
def intersect_offset(ids: Tensor, images: int, columns: int, rows: int) -> Tensor:
    return reference._isect_offset_encode(ids, images, columns, rows)


@kernel
def rasterize_to_pixels_3dgs_fwd(
    means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor, backgrounds: Tensor | None,
    masks: None, width: int, height: int, size: int, offsets: Tensor, ids: Tensor,
) -> tuple[Tensor | None, ...]:  # fmt: skip
    assert masks is None
    inputs = (means2d, conics, colors, opacities, width, height, size, offsets, ids, backgrounds)
    return *reference._rasterize_to_pixels(*inputs), None


@kernel
def rasterize_to_pixels_3dgs_bwd(
    means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor, backgrounds: Tensor | None,
    masks: None, width: int, height: int, size: int, offsets: Tensor, ids: Tensor, alphas: Tensor, last: None,
    v_colors: Tensor, v_alphas: Tensor, absolute: bool,
) -> tuple[Tensor | None, ...]:  # fmt: skip
    assert not absolute
    gradients = pullback(
        lambda *leaves: reference._rasterize_to_pixels(
            *leaves, width, height, size, offsets, ids, backgrounds
        ),
        [means2d, conics, colors, opacities],
        [v_colors, v_alphas],
    )
    return None, *gradients


@torch.enable_grad()
def pullback(
    function: Callable[..., tuple[Tensor, ...]], inputs: list[Tensor], upstream: list[Tensor]
) -> tuple[Tensor, ...]:
    """Gradients with respect to the inputs."""
    leaves = [each.detach().requires_grad_() for each in inputs]
    results = function(*leaves)
    # If nothing is drawn, the results do not depend on the inputs.
    total = sum((result * factor).sum() for result, factor in zip(results, upstream, strict=True))
    total = total + sum(0 * leaf.sum() for leaf in leaves)
    return torch.autograd.grad(total, leaves)


def rasterize_to_indices_3dgs(
    first: int, last: int, transmittances: Tensor, means2d: Tensor, conics: Tensor, opacities: Tensor,
    width: int, height: int, size: int, offsets: Tensor, ids: Tensor,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Pairs of contributing Gaussians [M] and pixels [M], in the order of pixels, then depth."""
    count, (_, rows, columns) = means2d.shape[-2], offsets.shape
    ends = torch.cat([offsets.flatten()[1:], offsets.new_tensor([len(ids)])]).tolist()
    gaussians, pixels = [ids.new_empty(0)], [ids.new_empty(0)]
    for tile, (start, end) in enumerate(zip(offsets.flatten().tolist(), ends, strict=True)):
        image, row, column = tile // (rows * columns), tile // columns % rows, tile % columns
        block = size * size
        drawn = ids[min(end, start + first * block) : min(end, start + last * block)].long()
        x = torch.arange(column * size, min(width, (column + 1) * size))
        y = torch.arange(row * size, min(height, (row + 1) * size))
        y, x = (each.flatten() for each in torch.meshgrid(y, x, indexing="ij"))
        places = torch.stack([x, y], -1) + 0.5
        delta = places[:, None] - means2d.reshape(-1, 2)[drawn]  # [P, G, 2]
        a, b, c = conics.reshape(-1, 3)[drawn].unbind(-1)
        exponent = 0.5 * (a * delta[..., 0] ** 2 + c * delta[..., 1] ** 2) + b * delta[..., 0] * delta[..., 1]
        alphas = (opacities.reshape(-1)[drawn] * (-exponent).exp()).clamp_max(ALPHA_MAX)
        counts = (exponent >= 0) & (alphas >= ALPHA_MIN)
        left = transmittances[image, y, x][:, None] * torch.where(counts, 1 - alphas, 1).cumprod(1)
        where, which = (counts & (left > TRANSMITTANCE_MIN)).nonzero(as_tuple=True)
        gaussians.append(drawn[which] % count)
        pixels.append((image * height + y[where]) * width + x[where])
    return torch.cat(gaussians).long(), torch.cat(pixels).long()


def render_weight_from_alpha(alphas: Tensor, ray_indices: Tensor, n_rays: int) -> tuple[Tensor, Tensor]:
    """As in nerfacc: blending weights [M] and transmittances [M]."""
    _, rays, lengths = ray_indices.unique_consecutive(return_inverse=True, return_counts=True)
    places = rays, torch.arange(len(rays)) - (lengths.cumsum(0) - lengths)[rays]
    left = torch.ones(len(lengths), int(lengths.max()) + 1)
    left = left.index_put((places[0], places[1] + 1), 1 - alphas).cumprod(1)
    before = left[places]
    return alphas * before, before


def accumulate_along_rays(weights: Tensor, values: Tensor | None, ray_indices: Tensor, n_rays: int) -> Tensor:
    """As in nerfacc: sums [n_rays, D] of weighted values along rays."""
    weighted = weights[:, None] if values is None else weights[:, None] * values
    return torch.zeros(n_rays, weighted.shape[1]).index_add(0, ray_indices, weighted)


COMPILED = SimpleNamespace(
    CameraModelType="pinhole",
    PINHOLE="pinhole",
    projection_ewa_3dgs_fused_fwd=projection_ewa_3dgs_fused_fwd,
    projection_ewa_3dgs_fused_bwd=projection_ewa_3dgs_fused_bwd,
    spherical_harmonics_fwd=spherical_harmonics_fwd,
    spherical_harmonics_bwd=spherical_harmonics_bwd,
    intersect_tile=intersect_tile,
    intersect_offset=intersect_offset,
    rasterize_to_pixels_3dgs_fwd=rasterize_to_pixels_3dgs_fwd,
    rasterize_to_pixels_3dgs_bwd=rasterize_to_pixels_3dgs_bwd,
    rasterize_to_indices_3dgs=rasterize_to_indices_3dgs,
)
NERFACC = SimpleNamespace(
    render_weight_from_alpha=render_weight_from_alpha, accumulate_along_rays=accumulate_along_rays
)
