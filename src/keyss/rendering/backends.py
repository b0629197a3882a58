"""Selection of the device that renders."""

from __future__ import annotations

import warnings
from typing import Literal

import torch

from keyss.core import BackendError, UsageError

Backend = Literal["auto", "cpu", "cuda"]


def resolve_device(backend: Backend = "auto") -> torch.device:
    """The device for the Gaussians, which also selects the rasterizer.

    "auto" is CUDA if torch sees a GPU, else the CPU; a GPU that gsplat cannot use is skipped with a
    RuntimeWarning. Raises BackendError if "cuda" cannot be used.
    """
    if backend not in ("auto", "cpu", "cuda"):
        raise UsageError(f"device: expected 'auto', 'cpu' or 'cuda', got {backend!r}")
    if backend == "cpu" or (backend == "auto" and not torch.cuda.is_available()):
        return torch.device("cpu")
    try:
        require_gsplat_cuda()
    except BackendError as error:
        if backend == "cuda":
            raise
        warnings.warn(f"rendering on the CPU: {error}", RuntimeWarning, stacklevel=2)
        return torch.device("cpu")
    return torch.device("cuda")


def require_gsplat_cuda() -> None:
    """Raise BackendError unless gsplat can render on a GPU. May compile its kernels, which takes minutes."""
    if not torch.cuda.is_available():
        raise BackendError("torch sees no CUDA GPU on this machine; use device 'auto' or 'cpu'")
    try:
        from gsplat.cuda._backend import _C
    except (ImportError, OSError, RuntimeError) as error:
        raise BackendError(f"gsplat's CUDA kernels cannot be loaded ({error}); use device 'cpu'") from error
    if _C is None:
        raise BackendError(
            "gsplat's CUDA kernels are missing, and without a CUDA toolkit (nvcc) they cannot be built; "
            "use device 'cpu'"
        )
