"""What could be saved by drawing only what adds to a pixel of the asked views.

`python benchmarks/culling.py MODEL.ply ...`: ratios within one run, in processor time of one thread, from 24
cameras around each model, and from the first of them alone.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path

from keyss.files import read_model
from keyss.rendering import render
from keyss.rendering.contributions import contributions
from keyss.rendering.orbit import orbit
from rasterizer import table

import torch

SIZE, VIEWS, REPEATS = 400, 24, 5  # pixels, cameras, of which the fastest counts


def seconds(work: Callable[[], object]) -> float:
    """Processor time of `work` on this thread."""
    times = []
    for _ in range(REPEATS):
        start = time.thread_time()
        work()
        times.append(time.thread_time() - start)
    return min(times)


@torch.no_grad()
def row(file: Path, views: int) -> list[str]:
    """What one model comes to."""
    model = read_model(file)
    cameras = orbit(model, SIZE, VIEWS)[:views]
    kept = model[contributions(model, cameras) > 0]
    same = sum(torch.equal(render(model, camera), render(kept, camera)) for camera in cameras)
    whole = seconds(lambda: [render(model, camera) for camera in cameras])
    less = seconds(lambda: [render(kept, camera) for camera in cameras])
    find = seconds(lambda: contributions(model, cameras))
    ratios = (f"{less / whole:.2f}", f"{find / whole:.1f}")
    return [file.stem, str(views), f"{len(kept) / len(model):.1%}", f"{same} of {views}", *ratios]


def main() -> None:
    torch.set_num_threads(1)
    rows = [row(Path(name), views) for name in sys.argv[1:] for views in (1, VIEWS)]
    print(
        table(["model", "views", "Gaussians that add", "same pictures", "drawing them", "finding them"], rows)
    )


if __name__ == "__main__":
    main()
