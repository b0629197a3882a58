"""Arrays for the kernels, aligned to cache lines."""

from __future__ import annotations

import math
import threading
from typing import Any

import numpy as np
import torch

_buffers = threading.local()


def aligned(shape: tuple[int, ...], dtype: Any) -> np.ndarray[Any, Any]:
    """An uninitialised array that starts on a cache line, as torch's tensors do and numpy's do not."""
    size = math.prod(shape) * np.dtype(dtype).itemsize
    return torch.empty(size, dtype=torch.uint8).numpy().view(dtype).reshape(shape)


def scratch(name: str, shape: tuple[int, ...], dtype: Any) -> np.ndarray[Any, Any]:
    """An uninitialised array that is valid until the same thread asks for the same name again.

    Its memory is kept: pages fresh from the system would cost as much time as the arithmetic.
    """
    size = math.prod(shape) * np.dtype(dtype).itemsize
    buffer: np.ndarray[Any, Any] | None = getattr(_buffers, name, None)
    if buffer is None or len(buffer) < size:
        buffer = aligned((size + size // 4,), np.uint8)
        setattr(_buffers, name, buffer)
    return buffer[:size].view(dtype).reshape(shape)
