"""The rasterizer for CUDA: gsplat itself."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from keyss.rendering.arguments import ONLY_VALUES
from keyss.rendering.backends import require_gsplat_cuda


def rasterize(arguments: dict[str, Any]) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Call `gsplat.rasterization` unpacked. Raises BackendError where its CUDA kernels are missing."""
    require_gsplat_cuda()
    import gsplat

    supported = {name: value for name, value in arguments.items() if name not in ONLY_VALUES}
    colors, alphas, meta = gsplat.rasterization(**{**supported, "packed": False})
    return colors, alphas, meta
