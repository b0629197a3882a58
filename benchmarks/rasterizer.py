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
from dataclasses import dataclass
from functools import partial
from itertools import pairwise, product
from pathlib import Path

from keyss.core import Camera, Gaussians
from keyss.files import read_model
from keyss.rendering import rasterization, render

import psutil
import torch
from torch import Tensor


@dataclass(frozen=True)
class Case:
    """The scene to render: a file, or this many synthetic Gaussians."""

    name: str
    width: int
    height: int
    source: int | Path

    def scene(self) -> tuple[Gaussians, Camera]:
        model = read_model(self.source) if isinstance(self.source, Path) else synthetic_model(self.source)
        return model, camera_before(model.means, self.width, self.height)


CASES = (Case("50k synthetic", 400, 266, 50_000), Case("200k synthetic", 780, 520, 200_000))
LARGE = Case("1M synthetic", 1600, 1066, 1_000_000)


def synthetic_model(count: int) -> Gaussians:
    """A cloud of Gaussians of SH degree 3 whose sizes shrink with their number, like in fitted scenes."""
    normal = partial(torch.randn, generator=torch.Generator().manual_seed(0))
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


def measure_rasterizer(case: Case, threads: int, repeats: int) -> list[str]:
    """One row of the table."""
    torch.set_num_threads(threads)
    load_kernels()  # not counted as peak memory
    model, camera = case.scene()
    tensors = (model.means, model.quats, model.scales, model.opacities, model.sh)
    leaves = [tensor.detach().requires_grad_() for tensor in tensors]
    view = camera.viewmat, camera.K, camera.width, camera.height
    weights = torch.randn(camera.height, camera.width, 3, generator=torch.Generator().manual_seed(1))
    times: list[tuple[float, ...]] = []
    before = psutil.Process().memory_info().rss
    for _ in range(repeats + 1):  # the first is a warm-up
        clock = [time.perf_counter()]
        with torch.no_grad():
            rasterization(*leaves, *view, sh_degree=model.sh_degree)
        clock.append(time.perf_counter())
        image = rasterization(*leaves, *view, sh_degree=model.sh_degree)[0]
        clock.append(time.perf_counter())
        image.backward(weights)
        clock.append(time.perf_counter())
        times.append(tuple(1e3 * (after - start) for start, after in pairwise(clock)))
        del image
        for leaf in leaves:
            leaf.grad = None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 - before
    parts = [f"{min(part):.1f} ({statistics.median(part):.1f})" for part in zip(*times[1:], strict=True)]
    return [f"{case.name}, {case.width}x{case.height}", str(threads), *parts, f"{peak / 2**20:.0f}"]


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
        cases += [Case(file.stem, 780, 520, file) for file in files]
    load_kernels()  # compiles them, for the processes below to load

    context = multiprocessing.get_context("spawn")
    print(
        f"{platform.machine()}, {os.cpu_count()} cores; Python {platform.python_version()}, torch "
        f"{torch.__version__}. Milliseconds of wall time: the smallest of {options.repeats} repeats, and in "
        "brackets the median.\n"
    )
    print("| scene, SH 3 | threads | forward only | forward | backward | peak MiB |")
    print("| --- | --- | --- | --- | --- | --- |")
    for case, threads in product(cases, options.threads):
        with context.Pool(1) as pool:
            row = pool.apply(measure_rasterizer, (case, threads, options.repeats))
        print(f"| {' | '.join(row)} |", flush=True)


if __name__ == "__main__":
    main()
