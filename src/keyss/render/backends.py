"""Which machine renders: the one place that decides."""

from __future__ import annotations

from typing import Literal

import torch

from keyss.core import BackendError, UsageError

Backend = Literal["auto", "cpu", "cuda"]


def resolve_device(backend: Backend = "auto") -> torch.device:
    """The device on which to keep Gaussians: it decides which rasterizer draws them.

    "auto" takes CUDA where torch sees a GPU, otherwise the CPU. Raises BackendError when "cuda" is asked
    for and there is no GPU, or gsplat cannot use it.
    """
    if backend not in ("auto", "cpu", "cuda"):
        raise UsageError(f"device: expected 'auto', 'cpu' or 'cuda', got {backend!r}")
    if backend == "cpu" or (backend == "auto" and not torch.cuda.is_available()):
        return torch.device("cpu")
    if not torch.cuda.is_available():
        raise BackendError("device 'cuda': torch sees no CUDA GPU on this machine; use 'auto' or 'cpu'")
    require_gsplat_cuda()
    return torch.device("cuda")


def require_gsplat_cuda() -> None:
    """Raise BackendError unless gsplat's CUDA kernels can run. May compile them, which takes minutes."""
    try:
        from gsplat.cuda._backend import _C
    except (ImportError, OSError, RuntimeError) as error:
        raise BackendError(f"gsplat's CUDA kernels cannot be loaded ({error}); use device 'cpu'") from error
    if _C is None:
        raise BackendError(
            "gsplat's CUDA kernels are missing, and without a CUDA toolkit (nvcc) they cannot be built; "
            "use device 'cpu'"
        )
