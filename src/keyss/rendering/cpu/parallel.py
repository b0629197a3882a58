"""Runs kernels on several threads.

Kernels release the GIL and take their work in small pieces from a shared counter, so ordinary Python
threads drive them. Compared with numba's own `prange` this costs no second compilation, is safe to call
from several threads and after a fork, and a core that is busy elsewhere only delays the piece it holds.
The pieces never depend on the number of threads, hence nor do the results.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import numpy as np
import torch

T = TypeVar("T")

_CORES = os.cpu_count() or 1
_pools: dict[int, ThreadPoolExecutor] = {}  # one per number of helper threads


def run(kernel: Callable[..., None], *arguments: Any) -> None:
    """Call `kernel(counter, *arguments)` on as many threads as torch uses; returns when all pieces are done.

    `counter` is an int64 array of one zero: the kernel draws the number of its next piece from it with
    `simd8.fetch_add` until there are no more pieces.
    """
    counter = np.zeros(1, np.int64)
    helpers = min(torch.get_num_threads(), _CORES) - 1
    # The first call loads a kernel, which one thread does while the others wait. Ctrl-C at that moment may
    # leave a lock of LLVM's bindings locked: nobody may be waiting for a helper that waits for it.
    if helpers < 1 or not getattr(kernel, "overloads", True):
        kernel(counter, *arguments)
        return
    tasks = [_pool(helpers).submit(kernel, counter, *arguments) for _ in range(helpers)]
    try:
        kernel(counter, *arguments)
    finally:
        # By now every piece is taken: a helper that has not started has nothing left to do.
        for task in tasks:
            if not task.cancel():
                task.result()


def in_blocks(function: Callable[[int, int], T], count: int, size: int) -> list[T]:
    """`function(start, stop)` of all blocks of `size` below `count`, in their order.

    Each runs on one of as many threads as torch uses, which helps where it releases the GIL.
    """
    starts = range(0, count, size)
    results: dict[int, T] = {}

    def work(waiting: Iterator[int]) -> None:
        for start in waiting:  # the next one of all threads
            results[start] = function(start, min(start + size, count))

    waiting = iter(starts)
    helpers = min(torch.get_num_threads(), _CORES, len(starts)) - 1
    tasks = [_pool(helpers).submit(work, waiting) for _ in range(helpers)]
    try:
        work(waiting)
    finally:
        for task in tasks:
            if not task.cancel():
                task.result()
    return [results[start] for start in starts]


def _pool(helpers: int) -> ThreadPoolExecutor:
    pool = _pools.get(helpers)
    if pool is None:
        pool = _pools[helpers] = ThreadPoolExecutor(helpers, thread_name_prefix="keyss-render")
    return pool


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pools.clear)  # threads do not survive a fork
