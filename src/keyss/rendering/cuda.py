"""The rasterizer for CUDA: gsplat itself."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from keyss.rendering.backends import require_gsplat_cuda


def rasterize(**arguments: Any) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Call `gsplat.rasterization` unpacked. Raises BackendError where its CUDA kernels are missing."""
    require_gsplat_cuda()
    import gsplat

    colors, alphas, meta = gsplat.rasterization(**arguments, packed=False)
    return colors, alphas, meta
