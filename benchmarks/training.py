"""Training on large photos: what a step spends its time on, and PSNR with and without shrunk photos.

    python benchmarks/training.py ../shared/data/bonsai           # 1,000 steps, 100,000 Gaussians
    python benchmarks/training.py ../shared/data/bonsai --steps 3000 --coarse 0 0.5 0.7

`--coarse` are values of `FitConfig.coarse`, the share of the run with shrunk photos. Their runs take turns of
50 steps, so that they meet the same load, and start from the same seed. Seconds are those of the processor,
all threads together; loading, and measuring PSNR on the test photos, do not count.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

from keyss import FitConfig
from keyss.core import Scene
from keyss.files import load_scene
from keyss.fitting import CappedStrategy, PlainRun, RowAdam, mean_psnr, own_randomness, plain
from keyss.fitting.losses import Targets

import torch

TURN = 50  # steps
PARTS: dict[str, tuple[Any, str]] = {
    "forward": (plain, "render_with_meta"),
    "targets": (Targets, "of"),
    "loss": (plain, "photometric_loss"),
    "backward": (torch.Tensor, "backward"),
    "Adam": (RowAdam, "step"),
    "density control": (CappedStrategy, "step_post_backward"),
}


class Training:
    """A run, and the processor seconds of its parts."""

    def __init__(self, scene: Scene, config: FitConfig) -> None:
        self.run = PlainRun(scene, config, torch.device("cpu"))
        self.parts: Counter[str] = Counter()
        with own_randomness(config.known_seed):
            self.random = torch.get_rng_state()

    def turn(self) -> None:
        """Take some steps."""
        with own_randomness(0):
            torch.set_rng_state(self.random)
            for _ in range(min(TURN, self.run.iterations - self.run.iteration)):
                self.timed("step", self.run.step)()
            self.random = torch.get_rng_state()

    def timed(self, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            start = time.process_time()
            try:
                return function(*arguments, **options)
            finally:
                self.parts[part] += time.process_time() - start

        return call


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("scene", type=Path, help="folder of photos with cameras")
    parser.add_argument("--width", type=int, help="of the photos in pixels, if not all")
    parser.add_argument("--gaussians", type=int, default=100_000)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--coarse", type=float, nargs="+", default=[0.0, 0.5])
    options = parser.parse_args()
    scene = load_scene(options.scene, width=options.width)
    size = {"iterations": options.steps, "max_gaussians": options.gaussians, "seed": 0}
    trainings = {coarse: Training(scene, FitConfig(coarse=coarse, **size)) for coarse in options.coarse}
    for _ in range(-(-options.steps // TURN)):
        for training in trainings.values():
            patches = [
                mock.patch.object(*place, training.timed(part, getattr(*place)))
                for part, place in PARTS.items()
            ]
            for patch in patches:
                patch.start()
            training.turn()
            for patch in patches:
                patch.stop()
    print(f"| coarse | PSNR | seconds | {' | '.join(PARTS)} |")
    print("| --- " * (3 + len(PARTS)) + "|")
    for coarse, training in trainings.items():
        psnr = mean_psnr(training.run.gaussians(), scene.test, scene.background)
        total = training.parts["step"]
        shares = " | ".join(f"{training.parts[part] / total:.0%}" for part in PARTS)
        print(f"| {coarse:g} | {psnr:.2f} | {total:.0f} | {shares} |")


if __name__ == "__main__":
    main()
