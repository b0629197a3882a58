"""Run kernels on several threads.

Kernels release the GIL and take small pieces of work from a shared counter, so that ordinary Python threads
can run them. Unlike numba's `prange`, this needs no second compilation, is safe in several threads and after
a fork, and a busy core delays only its current piece. Pieces, and hence results, do not depend on the number
of threads.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import islice
from typing import Any, TypeVar

import numpy as np
import torch

T = TypeVar("T")

_CORES = os.cpu_count() or 1
_MAX_HELPERS = 1024


def run(kernel: Callable[..., None], *arguments: Any) -> None:
    """Call `kernel(counter, *arguments)` on as many threads as torch uses; returns when all pieces are done.

    `counter` is an int64 array of one zero, from which the kernel takes the number of its next piece with
    `simd8.fetch_add`.
    """
    # The first call loads the kernel under a lock of LLVM's bindings. Ctrl-C may leave it locked, and a
    # helper thread waiting for it would block this one.
    limit = _CORES if getattr(kernel, "overloads", True) else 1
    _on_threads(limit, kernel, np.zeros(1, np.int64), *arguments)


def in_blocks(
    function: Callable[[int, int], T], count: int, size: int, kernel: Callable[..., Any] | None = None
) -> list[T]:
    """Results of `function(start, stop)` for all blocks of `size` below `count`, in order.

    Runs on as many threads as torch uses, which helps if `function` releases the GIL. `kernel`: called by
    `function`; this thread loads it, see `run`.
    """
    starts = range(0, count, size)
    results: dict[int, T] = {}

    def work(waiting: Iterator[int]) -> None:
        try:
            for start in waiting:  # shared by all threads
                results[start] = function(start, min(start + size, count))
        except BaseException:
            for _ in waiting:  # the other threads only finish their blocks
                pass
            raise

    waiting = iter(starts)
    if not getattr(kernel, "overloads", True):
        work(islice(waiting, 1))
    _on_threads(min(_CORES, len(starts)), work, waiting)
    return [results[start] for start in starts]


def _on_threads(limit: int, work: Callable[..., None], *arguments: Any) -> None:
    """Call `work` on this thread and on helpers, at most `limit` in total; returns when all are done."""
    helpers = min(torch.get_num_threads(), limit) - 1
    tasks = [_pool(os.getpid()).submit(work, *arguments) for _ in range(helpers)]
    try:
        work(*arguments)
    finally:
        # All pieces are taken by now, so helpers that have not started can be cancelled.
        for task in tasks:
            if not task.cancel():
                task.result()


@cache
def _pool(process: int) -> ThreadPoolExecutor:
    """The helpers of a process, which do not survive a fork. Threads start when they are needed."""
    return ThreadPoolExecutor(_MAX_HELPERS, thread_name_prefix="keyss-render")
