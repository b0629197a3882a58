"""Upper bounds on the speedup of the CPU rasterizer by threads: see `--help`.

Kernels take pieces of work from a counter (`keyss.rendering.cpu.parallel`). Here one thread does all pieces
of a scene, and the processor time of each is measured. Then the pieces are assigned to T threads like by the
counter: the next piece to the first free thread. The result is an upper bound, without the costs of shared
memory, caches and waking threads. It does not need T cores.

Pieces of the two blending kernels, runs of tiles, are timed one by one. Times of the other kernels are
divided in proportion to Gaussians (`project`) or pairs with tiles (`list_pairs`, `sort_pairs`). Undivided
work (sorting by depth, the places of pairs, everything outside of kernels) is on one thread.
"""

from __future__ import annotations

import argparse
import heapq
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest.mock import patch

from keyss.rendering import rasterization
from keyss.rendering.cpu import rasterization as cpu
from keyss.rendering.cpu.layout import CHUNK, TILE_RUN
from rasterizer import CASES, Case, load_kernels, table

import numpy as np
import torch

THREADS = (1, 2, 4, 8, 16, 32)
_WHOLE = ("sort_by_depth",)  # kernels without pieces
_ENDS = {"blend": 9, "blend_backward": 5}  # index of the argument that holds the last entries of tiles


def makespan(pieces: Sequence[float], threads: int) -> float:
    """Time until the last of `threads` ends that take `pieces` in order, each when it is free."""
    free = [0.0] * threads
    for piece in pieces:
        heapq.heappush(free, heapq.heappop(free) + piece)
    return max(free)


@dataclass
class Pass:
    """Seconds of the pieces of each kernel in a forward or backward pass, and of the rest."""

    pieces: dict[str, list[float]] = field(default_factory=dict)
    alone: float = 0.0

    def seconds(self, threads: int) -> float:
        return self.alone + sum(makespan(each, threads) for each in self.pieces.values())

    def minimum(self, other: Pass) -> Pass:
        """Elementwise minimum of two measurements."""
        if not self.pieces:
            return other
        pieces = {name: list(map(min, each, other.pieces[name])) for name, each in self.pieces.items()}
        return Pass(pieces, min(self.alone, other.alone))


def measure(case: Case, threads: int, repeats: int) -> tuple[Pass, Pass]:
    """Forward and backward pass with the pieces for `threads`; minimum of `repeats`."""
    torch.set_num_threads(1)
    gaussians, camera = case.scene()
    tensors = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh)
    leaves = [tensor.detach().requires_grad_() for tensor in tensors]
    weights = torch.randn(camera.height, camera.width, 3, generator=torch.Generator().manual_seed(1))
    size = (camera.width, camera.height)
    best = (Pass(), Pass())
    for _ in range(repeats):
        with timed(threads) as forward:
            images, _, _ = rasterization(
                *leaves, camera.viewmat[None], camera.K[None], *size, sh_degree=gaussians.sh_degree
            )
        with timed(threads) as backward:
            images[0].backward(weights)
        best = (best[0].minimum(forward), best[1].minimum(backward))
    return best


@contextmanager
def timed(threads: int) -> Iterator[Pass]:
    """Time the block on this thread, with the pieces for `threads`."""
    found, inside = Pass(), 0.0

    def run(kernel: Callable[..., None], *arguments: Any) -> None:
        nonlocal inside
        start = time.thread_time()
        found.pieces[kernel.__name__] = _pieces(kernel, arguments)
        inside += time.thread_time() - start

    def whole(function: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*arguments: Any) -> Any:
            nonlocal inside
            start = time.thread_time()
            result = function(*arguments)
            found.pieces[function.__name__] = [time.thread_time() - start]
            inside += found.pieces[function.__name__][0]
            return result

        return timed

    with ExitStack() as patches:
        patches.enter_context(patch.object(cpu, "run", run))
        patches.enter_context(patch.object(torch, "get_num_threads", lambda: threads))
        for name in _WHOLE:
            patches.enter_context(patch.object(cpu.binning, name, whole(getattr(cpu.binning, name))))
        start = time.thread_time()
        yield found
        found.alone = time.thread_time() - start - inside


def _pieces(kernel: Callable[..., None], arguments: tuple[Any, ...]) -> list[float]:
    """Run a kernel; returns seconds of its pieces, in order."""
    if (place := _ENDS.get(kernel.__name__)) is not None:
        ends = arguments[place]
        call = min(_seconds(kernel, len(ends), arguments) for _ in range(5))  # overhead of a call: no pieces
        return [
            max(
                0.0,
                _seconds(
                    kernel, piece, (*arguments[:place], ends[: first + TILE_RUN], *arguments[place + 1 :])
                )
                - call,
            )
            for piece, first in enumerate(range(0, len(ends), TILE_RUN))
        ]
    seconds = _seconds(kernel, 0, arguments)
    if kernel.__name__ in ("list_pairs", "sort_pairs"):
        weights = np.diff(arguments[4 if kernel.__name__ == "list_pairs" else 1]).astype(float)
    else:
        count = len(arguments[0].means)
        weights = np.array([min(CHUNK, count - first) for first in range(0, count, CHUNK)], float)
    return list(seconds * weights / max(1.0, weights.sum()))


def _seconds(kernel: Callable[..., None], first: int, arguments: tuple[Any, ...]) -> float:
    """Processor time of the pieces starting at `first`."""
    counter = np.array([first])
    start = time.thread_time()
    kernel(counter, *arguments)
    return time.thread_time() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--models", type=Path, nargs="*", default=(), help="3DGS .ply files to draw too")
    parser.add_argument("--repeats", type=int, default=5, help="repeats of each measurement")
    options = parser.parse_args()
    load_kernels()
    cases = [*CASES, *(Case(name=file.stem, width=780, height=520, file=file) for file in options.models)]
    bounds, balance = [], []
    for case in cases:
        passes = {threads: measure(case, threads, options.repeats) for threads in THREADS}
        for row, way in enumerate(("forward", "backward")):
            title = f"{case.name}, {case.width}x{case.height}"
            one = passes[1][row]
            divided = [name for name in one.pieces if name not in _WHOLE]
            alone = 1 - sum(sum(one.pieces[name]) for name in divided) / one.seconds(1)
            speedups = [each[row].seconds(1) / each[row].seconds(n) for n, each in passes.items()]
            bounds.append([title, way, f"{alone:.0%}", *(f"{speedup:.1f}" for speedup in speedups)])
            for kernel in divided:
                share = sum(one.pieces[kernel]) / one.seconds(1)
                cells = [kernel, f"{share:.0%}", str(len(passes[THREADS[-1]][row].pieces[kernel]))]
                for n, each in passes.items():
                    found = each[row].pieces[kernel]
                    cells.append(f"{makespan(found, n) * n / sum(found):.2f}")
                balance.append([title, *cells])
    threads = [f"{n}" for n in THREADS]
    print(table(["speedup at most, by threads", "pass", "on one thread", *threads], bounds), end="\n\n")
    print(table(["longest thread / mean, by threads", "kernel", "of the time", "pieces", *threads], balance))


if __name__ == "__main__":
    main()
