"""Arrays for the kernels, aligned to cache lines, in recycled memory.

A call needs tens of megabytes for a few milliseconds. Page faults of fresh memory would cost as much as the
arithmetic.
"""

from __future__ import annotations

import ctypes
import math
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import torch

Array = np.ndarray[Any, Any]

MAX_FREE = 40  # unused buffers to keep: slightly more than one call needs
MIN_BYTES = 2**15  # smaller arrays come from numpy

# Free buffers by capacity, in the order in which the capacities were needed. The garbage collector may end a
# loan at any moment, so there is no lock: all operations are atomic.
_free: dict[int, list[Array]] = {}


class _Loan:
    """Owns a buffer for the arrays in it, and returns it when the last of them is gone."""

    def __init__(self, buffer: Array) -> None:
        self.buffer = buffer
        self.__array_interface__ = buffer.__array_interface__

    def __del__(self) -> None:
        if _free is not None:  # it is None at interpreter exit
            _free.setdefault(len(self.buffer), []).append(self.buffer)


def empty(shape: tuple[int, ...], dtype: Any) -> Array:
    """An uninitialised array; large arrays start on a cache line."""
    size = math.prod(shape) * np.dtype(dtype).itemsize
    if size < MIN_BYTES:
        return np.empty(shape, dtype)
    array: Array = np.asarray(_Loan(_buffer(size)))[:size].view(dtype).reshape(shape)
    return array


def release() -> None:
    """Give unused memory back to the system: all buffers, and what the C library keeps for each thread.

    Large models leave hundreds of megabytes. Takes 10 ms.
    """
    _free.clear()
    if sys.platform == "linux":
        with suppress(AttributeError):  # only glibc has it
            ctypes.CDLL(None).malloc_trim(0)


def available_memory() -> int:
    """Bytes available on the machine and in its container (Linux, cgroup 2)."""
    available: int = psutil.virtual_memory().available
    with suppress(OSError, ValueError, KeyError):  # "max" without a limit
        group = Path("/sys/fs/cgroup")
        limit, used = (int((group / f"memory.{name}").read_text()) for name in ("max", "current"))
        cached = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
        available = min(available, limit - used + int(cached["inactive_file"]))
    return available


def _buffer(size: int) -> Array:
    """The smallest free buffer that is at most twice as large as needed, or a new one."""
    step = 1 << max(0, size.bit_length() - 3)  # between capacities: an eighth to a quarter of the size
    capacity = -(-size // step) * step
    for fitting in range(capacity, 2 * size + 1, step):
        with suppress(KeyError, IndexError):
            return _free[fitting].pop()
    for stale in list(_free):  # the oldest first: models grow
        if sum(len(arrays) for arrays in list(_free.values())) <= MAX_FREE:
            break
        _free.pop(stale, None)
    new: Array = torch.empty(capacity, dtype=torch.uint8).numpy()
    return new
