"""`rasterization`: gsplat's function of that name, on the device of the Gaussians."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from keyss.core import UsageError
from keyss.rendering.backends import require_gsplat_cuda
from keyss.rendering.cpu.constants import EPS2D_MIN
from keyss.rendering.cpu.rasterization import Settings, rasterize as rasterize_on_cpu
from keyss.rendering.rasterization_checks import check_arguments


def rasterization(
    means: Tensor,  # [N, 3]
    quats: Tensor,  # [N, 4]
    scales: Tensor,  # [N, 3]
    opacities: Tensor,  # [N]
    colors: Tensor,  # [N, K, 3] or [N, D]
    viewmats: Tensor,  # [C, 4, 4]
    Ks: Tensor,  # [C, 3, 3]
    width: int,
    height: int,
    *,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    eps2d: float = EPS2D_MIN,
    sh_degree: int | None = None,
    backgrounds: Tensor | None = None,  # [C, D]
    **others: Any,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render N Gaussians into C images (3DGS, Kerbl et al. 2023, eq. 3 to 5), like `gsplat.rasterization`.

    Gaussians on the CPU are rendered by the kernels in `keyss.rendering.cpu`, those on a GPU by gsplat.

    Args:
        means: centres in the world.
        quats: rotations as wxyz, of any length.
        scales: standard deviations, positive.
        opacities: in [0, 1].
        colors: SH coefficients where `sh_degree` is given, with colour = max(0.5 + basis . colors, 0);
            else 1 to 32 feature channels, rendered without an activation.
        viewmats: world to camera, rigid motions, OpenCV axes.
        Ks: pinhole intrinsics in pixels, without skew; pixel centres are at half-integers.
        width: pixels.
        height: pixels.
        near_plane: minimum depth, positive.
        far_plane: maximum depth.
        eps2d: variance in pixels^2 added to every footprint, 0.3 or more.
        sh_degree: degree up to which to use the SH coefficients, 0 to 3, with K >= (sh_degree + 1)^2.
        backgrounds: colour behind everything; black when None.
        others: gsplat's other arguments. `packed`, `tile_size`, `channel_chunk` and `segmented`, which do not
            affect results, are ignored; all others must have gsplat's default.

    Returns:
        Images [C, H, W, D], not clamped above, with D = 3 for SH; alphas [C, H, W, 1] in [0, 1]; and a
        dictionary with the entries that gsplat's strategies read with `packed=False`: means2d [C, N, 2] in
        pixels (after backward its `.grad` holds dL/d(means2d)), radii [C, N, 2] int32 in pixels (0 for
        invisible Gaussians), depths [C, N], width, height, n_cameras, gaussian_ids (None).

    All tensors but the cameras have gradients. Everything is computed in float32. On the CPU, results are
    bit-identical for any number of threads; Gaussians that are not finite or have a colour of 1e12 or more
    are skipped; and means2d is a leaf: losses on it do not reach the means.

    Raises:
        ValueError: a shape, dtype or number is invalid.
        UsageError: gsplat may support an option, shape or device, but this function does not.
        BackendError: gsplat's CUDA kernels are missing, or the lists of tiles would take too much memory.
    """
    tensors = {
        "means": means,
        "quats": quats,
        "scales": scales,
        "opacities": opacities,
        "colors": colors,
        "viewmats": viewmats,
        "Ks": Ks,
    }
    if backgrounds is not None:
        tensors["backgrounds"] = backgrounds
    check_arguments(tensors, width, height, near_plane, far_plane, eps2d, sh_degree, others)
    tensors = {name: tensor.float() for name, tensor in tensors.items()}
    if means.device.type == "cuda":
        require_gsplat_cuda()
        import gsplat

        images, alphas, meta = gsplat.rasterization(
            **tensors,
            width=width,
            height=height,
            near_plane=near_plane,
            far_plane=far_plane,
            eps2d=eps2d,
            sh_degree=sh_degree,
            packed=False,
        )
        return images, alphas, meta
    if means.device.type != "cpu":
        raise UsageError(f"means: expected a tensor on 'cpu' or 'cuda', got {means.device}")
    if sh_degree is None:
        tensors["colors"] = tensors["colors"][:, None]
    if backgrounds is None:
        tensors["backgrounds"] = torch.zeros(len(viewmats), colors.shape[-1])
    settings = Settings(
        int(width),
        int(height),
        np.float32(near_plane),
        np.float32(far_plane),
        np.float32(eps2d),
        sh_count=0 if sh_degree is None else (sh_degree + 1) ** 2,
    )
    names = ("viewmats", "Ks", "backgrounds", "means", "quats", "scales", "opacities", "colors")
    images, alphas, meta = rasterize_on_cpu(settings, *(tensors[each].contiguous() for each in names))
    meta.update(
        width=settings.width,
        height=settings.height,
        n_cameras=len(viewmats),
        n_batches=1,
        batch_ids=None,
        camera_ids=None,
        gaussian_ids=None,
        opacities=tensors["opacities"].expand(len(viewmats), -1),
    )
    return images, alphas, meta
