"""Arrays for the kernels: aligned to cache lines, and made of memory that is used again.

Every call needs tens of megabytes for a few milliseconds. Taken from the system each time, the page
faults would cost as much as the arithmetic.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

Array = np.ndarray[Any, Any]

MAX_FREE = 40  # buffers kept while nobody uses them: what one call needs, and some
WORTH_KEEPING = 2**15  # bytes; smaller ones come from numpy

# Free buffers by identity, the longest unused first. A loan may end in the garbage collector at any
# moment, so there is no lock, only operations on the dictionary that are atomic.
_free: dict[int, Array] = {}


class _Loan:
    """Owns a buffer on behalf of the arrays made of it, and puts it back when the last of them is gone."""

    def __init__(self, buffer: Array) -> None:
        self.buffer = buffer
        self.__array_interface__ = buffer.__array_interface__

    def __del__(self) -> None:
        if _free is not None:  # as it is when the interpreter ends
            _free[id(self.buffer)] = self.buffer


def empty(shape: tuple[int, ...], dtype: Any) -> Array:
    """An uninitialised array; large ones start on a cache line."""
    size = math.prod(shape) * np.dtype(dtype).itemsize
    if size < WORTH_KEEPING:
        return np.empty(shape, dtype)
    array: Array = np.asarray(_Loan(_buffer(size)))[:size].view(dtype).reshape(shape)
    return array


def _buffer(size: int) -> Array:
    """The smallest free buffer that fits without wasting more than half of it, or a new one."""
    fitting = [(len(buffer), key) for key, buffer in list(_free.items()) if size <= len(buffer) <= 2 * size]
    for _, key in sorted(fitting):
        buffer = _free.pop(key, None)
        if buffer is not None:
            return buffer
    for key in list(_free)[:-MAX_FREE]:
        _free.pop(key, None)
    new: Array = torch.empty(size + size // 8, dtype=torch.uint8).numpy()
    return new
