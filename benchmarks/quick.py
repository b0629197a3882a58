"""Detect slowdowns in under two minutes: `make benchmark-check`, `make benchmark-baseline`.

    python benchmarks/quick.py             # measure and write the record of this commit
    python benchmarks/quick.py --check     # compare with the baseline; exit status 1 if slower
    python benchmarks/quick.py --baseline  # the record becomes the baseline

Every part alternates with a fixed workload on one thread: matrix products for floating-point parts, AES and
BLAKE2b over 32 MiB for encryption. The fastest round of each counts, in processor time. Ratios hardly depend
on the speed and load of the machine, but differ between types of processors (vector widths): store your own
baseline before a change, or trust only large differences.
"""

from __future__ import annotations

import argparse
import hashlib
import sys
import time
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from benchmark_record import RESULTS, make_record, read_record, regressions, write_record
from channels.quiet.trained_like import trained_like
from keyss.fitting.config import FitConfig
from keyss.fitting.losses import Target, photometric_loss
from keyss.fitting.parameters import make_optimizers, to_gaussians, to_parameters
from keyss.rendering import render
from methods.carry.carried import embed, extract
from rasterizer import camera_before, synthetic_model

import numpy as np
import torch
from cryptography.hazmat.primitives.ciphers import Cipher
from cryptography.hazmat.primitives.ciphers.algorithms import AES
from cryptography.hazmat.primitives.ciphers.modes import CTR
from threadpoolctl import threadpool_limits

BASELINE = RESULTS / "quick" / "baseline.json"
TOLERANCE = 0.5  # share by which a ratio may grow; it grew by up to 0.4 on a busy machine
WIDTH, HEIGHT, COUNT = 400, 266, 50_000  # workload of the renderer
CARRIED = 20_000  # Gaussians of cover and secret
KEY = "the key of the benchmark"

Part = Callable[[], object]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--check", action="store_true")
    parser.add_argument("--baseline", action="store_true")
    parser.add_argument("--rounds", type=int, default=12, help="rounds of each part")
    parser.add_argument("--tolerance", type=float, default=TOLERANCE, help="share by which a ratio may grow")
    options = parser.parse_args()

    torch.set_num_threads(1)
    with threadpool_limits(1):
        drawing = fastest({"matrix_product": matrix_product(), **drawing_parts()}, options.rounds)
        carrying = fastest({"encryption": encryption(), **carrying_parts()}, max(2, options.rounds // 2))
    numbers = {f"{name}_seconds": seconds for name, seconds in {**drawing, **carrying}.items()}
    ratios = {
        **over("matrix_product", drawing),
        "training_step / rasterizer": drawing["training_step"] / drawing["rasterizer"],
        **over("encryption", carrying),
    }
    record = make_record("quick", numbers, ratios)
    for name, ratio in ratios.items():
        print(f"{name:32} {ratio:8.3f}")
    if not options.check:
        print(write_record(record, BASELINE if options.baseline else None))
        return 0
    changes = regressions(record, read_record(BASELINE), options.tolerance)
    for change in changes:
        print(f"slower: {change}", file=sys.stderr)
    return 1 if changes else 0


def over(workload: str, seconds: dict[str, float]) -> dict[str, float]:
    """Each part's time / time of the fixed workload."""
    return {f"{name} / {workload}": seconds[name] / seconds[workload] for name in seconds if name != workload}


def fastest(parts: dict[str, Part], rounds: int) -> dict[str, float]:
    """Processor seconds of each part's fastest round. Parts alternate; the first round does not count."""
    best = dict.fromkeys(parts, float("inf"))
    for repeat in range(rounds + 1):
        for name, part in parts.items():
            start = time.process_time()
            part()
            if repeat:
                best[name] = min(best[name], time.process_time() - start)
    return best


def matrix_product() -> Part:
    """Four products of 1024 x 1024 matrices by numpy's BLAS."""
    matrix = np.random.default_rng(0).random((1024, 1024), np.float32)
    return lambda: [matrix @ matrix for _ in range(4)]


def encryption() -> Part:
    """AES-256 and BLAKE2b over 32 MiB."""
    data = bytes(2**25)

    def both() -> None:
        Cipher(AES(bytes(32)), CTR(bytes(16))).encryptor().update(data)
        hashlib.blake2b(data).digest()

    return both


def drawing_parts() -> dict[str, Part]:
    """The rasterizer forward and backward, the loss with its gradient, and a whole training step."""
    gaussians = synthetic_model(COUNT)
    camera = camera_before(gaussians.means, WIDTH, HEIGHT)
    config = FitConfig()
    with torch.no_grad():
        picture = render(gaussians, camera).clamp(0, 1)
        target = Target.of(picture.flip(1))
    weights = torch.randn(picture.shape, generator=torch.Generator().manual_seed(1))
    leaves = gaussians.map(lambda tensor: tensor.detach().clone().requires_grad_())
    leaf = picture.clone().requires_grad_()
    parameters = to_parameters(gaussians, torch.device("cpu"))
    optimizers = make_optimizers(parameters, config, 1.0)

    def training_step() -> None:
        photometric_loss(render(to_gaussians(parameters), camera), target, config.ssim_weight).backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)

    return {
        "rasterizer": lambda: render(leaves, camera).backward(weights),
        "loss": lambda: photometric_loss(leaf, target, config.ssim_weight).backward(),
        "training_step": training_step,
    }


def carrying_parts() -> dict[str, Part]:
    """Hiding one model in another without training, and revealing it, key derivation included."""
    cover, secret = trained_like(CARRIED, 0), trained_like(CARRIED, 1)
    stego = embed(cover, [(KEY, secret)])
    return {
        "carry_embed": lambda: embed(cover, [(KEY, secret)]),
        "carry_extract": lambda: extract(stego, KEY),
    }


if __name__ == "__main__":
    sys.exit(main())
