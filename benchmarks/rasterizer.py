"""Speed of the CPU rasterizer: `make benchmark-rasterizer`, or `python benchmarks/rasterizer.py --help`.

Each case runs in a separate process, to measure its peak memory. Times are wall times after a warm-up; the
minimum shows the cost of the code, the median that on this machine.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import os
import platform
import resource
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from keyss.core import Camera, Gaussians
from keyss.files import read_model
from keyss.rendering import rasterization, render

import torch
from torch import Tensor


@dataclass(frozen=True, kw_only=True)
class Case:
    """The scene to render: synthetic Gaussians, or those of a file."""

    name: str
    width: int
    height: int
    count: int = 0
    file: Path | None = None

    def scene(self) -> tuple[Gaussians, Camera]:
        gaussians = synthetic_model(self.count) if self.file is None else read_model(self.file)
        return gaussians, camera_before(gaussians.means, self.width, self.height)


CASES = (
    Case(name="50k synthetic", width=400, height=266, count=50_000),
    Case(name="200k synthetic", width=780, height=520, count=200_000),
)
LARGE = Case(name="1M synthetic", width=1600, height=1066, count=1_000_000)


def synthetic_model(count: int) -> Gaussians:
    """A cloud of Gaussians of SH degree 3 whose sizes shrink with their number, like in fitted scenes."""
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    return Gaussians(
        means=normal(count, 3) * torch.tensor([1.2, 0.8, 1.0]),
        quats=normal(count, 4),
        log_scales=math.log(0.42 * count ** (-1 / 3)) + 0.5 * normal(count, 3),
        opacity_logits=1.5 * normal(count),
        sh=0.2 * normal(count, 16, 3),
    )


def camera_before(means: Tensor, width: int, height: int) -> Camera:
    """A camera that sees most of the Gaussians, four spreads in front of their middle."""
    middle = means.median(0).values
    spread = (means - middle).abs().median(0).values.max() / 0.6745
    viewmat = torch.eye(4)
    viewmat[:3, 3] = -middle
    viewmat[2, 3] += 3.3 * spread
    K = torch.tensor([[1.1 * width, 0, width / 2], [0, 1.1 * width, height / 2], [0, 0, 1.0]])
    return Camera(viewmat=viewmat, K=K, width=width, height=height, name="benchmark")


def load_kernels() -> None:
    """Render a few Gaussians, forward and backward, to load the kernels."""
    gaussians = synthetic_model(10).map(lambda tensor: tensor.requires_grad_())
    render(gaussians, camera_before(gaussians.means.detach(), 8, 8)).sum().backward()


class Clock:
    """Milliseconds of each part of what is repeated; the first time is a warm-up."""

    def __init__(self) -> None:
        self.times: dict[str, list[float]] = {}

    def __call__(self, part: str, work: Callable[[], Any]) -> Any:
        start = time.perf_counter()
        result = work()
        self.times.setdefault(part, []).append(1e3 * (time.perf_counter() - start))
        return result

    def text(self, part: str) -> str:
        times = self.times[part][1:]
        return f"{min(times):.1f} ({statistics.median(times):.1f})"


def leaves_of(model: Gaussians) -> list[Tensor]:
    tensors = (model.means, model.quats, model.scales, model.opacities, model.sh)
    return [tensor.detach().requires_grad_() for tensor in tensors]


def draw(leaves: list[Tensor], camera: Camera, sh_degree: int) -> Tensor:
    size = (camera.width, camera.height)
    return rasterization(*leaves, camera.viewmat, camera.K, *size, sh_degree=sh_degree)[0]


def measure_rasterizer(case: Case, threads: int, repeats: int) -> list[str]:
    """One row of the table."""
    torch.set_num_threads(threads)
    load_kernels()  # not counted as peak memory
    gaussians, camera = case.scene()
    leaves, clock = leaves_of(gaussians), Clock()
    weights = torch.randn(camera.height, camera.width, 3, generator=torch.Generator().manual_seed(1))
    work = partial(draw, leaves, camera, gaussians.sh_degree)
    before = _memory()
    for _ in range(repeats + 1):
        with torch.no_grad():
            clock("only", work)
        image = clock("forward", work)
        clock("backward", partial(image.backward, weights))
        del image
        for leaf in leaves:
            leaf.grad = None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 - before
    times = map(clock.text, ("only", "forward", "backward"))
    return [f"{case.name}, {case.width}x{case.height}", str(threads), *times, f"{peak / 2**20:.0f}"]


def _memory() -> int:
    """Bytes of memory in use by this process; the peak so far on systems that do not report it."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return pages * os.sysconf("SC_PAGESIZE")


def table(titles: list[str], rows: list[list[str]]) -> str:
    """A Markdown table."""
    return "\n".join(f"| {' | '.join(row)} |" for row in (titles, ["---"] * len(titles), *rows))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--large", action="store_true", help="1M Gaussians at 1600x1066 too")
    parser.add_argument("--models", type=Path, help="folder with 3DGS .ply files to draw too")
    parser.add_argument("--repeats", type=int, default=15, help="repeats of each measurement")
    parser.add_argument("--threads", type=int, nargs="+", default=sorted({1, os.cpu_count() or 1}))
    options = parser.parse_args()

    cases = [*CASES, *([LARGE] if options.large else [])]
    if options.models is not None:
        files = sorted(options.models.rglob("*.ply"))
        if not files:
            parser.error(f"--models: no .ply file in {options.models}")
        cases += [Case(name=file.stem, width=780, height=520, file=file) for file in files]
    load_kernels()  # compiles them, for the processes below to load

    context = multiprocessing.get_context("spawn")

    n = options.repeats
    pairs = [(case, threads) for case in cases for threads in options.threads]
    titles = ["scene, SH 3", "threads", "forward only", "forward", "backward", "peak MiB"]
    rows = []
    for case, threads in pairs:
        with context.Pool(1) as pool:
            rows.append(pool.apply(measure_rasterizer, (case, threads, n)))
    heading = (
        f"{platform.machine()}, {os.cpu_count()} cores; Python {platform.python_version()}, torch "
        f"{torch.__version__}. Milliseconds of wall time: the smallest of {n} repeats, and in brackets the "
        "median."
    )
    print(f"{heading}\n\n{table(titles, rows)}")


if __name__ == "__main__":
    main()
