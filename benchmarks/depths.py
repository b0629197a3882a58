"""Can new low bits be told from a model's own, whatever the trainer's rates?

    python benchmarks/depths.py ../shared/data -o out/depths                # 16 models of 20,000 Gaussians
    python benchmarks/depths.py ../shared/data -o out/depths --gaussians 20000 60000 200000 --models cuda.ply

Trains models of the scenes in DATA with four ratios of the rates of constant colours and other harmonics,
and keeps them in the folder `-o`, from which an interrupted run resumes. Prints, for each model, the share of
usable Gaussians, the depth that it allows, and the mean and the largest z of the detectors `steps`: its own
low bits against new ones of 8 bits. Detectors with too few candidates are left out.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

from keyss import FitConfig, Gaussians, read_model, write_model
from keyss.channels import Carriers, Layout
from keyss.core import UsageError
from keyss.files import load_scene
from keyss.fitting import fit_scene
from keyss.lab.stealth.low_bits import steps
from keyss.lab.stealth.statistic import BitPatterns

import torch

RATIOS = (20, 10, 5, 1)
CONSTANT_RATE = FitConfig().sh0_rate


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("data", type=Path, help="folder of scenes")
    parser.add_argument("-o", "--out", type=Path, required=True, help="folder of the trained models")
    parser.add_argument("--scenes", nargs="+", default=["bonsai", "fox", "lego", "miku"])
    parser.add_argument("--gaussians", nargs="+", type=int, default=[20_000])
    parser.add_argument("--models", nargs="*", type=Path, default=[], help="further models")
    parser.add_argument("--width", type=int, default=160)
    options = parser.parse_args()
    torch.set_num_threads(1)
    options.out.mkdir(parents=True, exist_ok=True)
    print("| model | Gaussians | usable | bits | mean z | largest z |\n| --- | --- | --- | --- | --- | --- |")
    every: list[float] = []
    for path in options.models:
        every += report(path.stem, read_model(path))
    for count in options.gaussians:
        for ratio in RATIOS:
            for scene in options.scenes:
                path = options.out / f"{scene}-{count}-{ratio}.ply"
                if not path.exists():
                    write_model(path, trained(options.data / scene, options.width, count, ratio))
                every += report(path.stem, read_model(path))
    print(f"{len(every)} detectors: mean z {sum(every) / len(every):+.2f}, largest {max(every):+.1f}")


def trained(scene: Path, width: int, count: int, ratio: int) -> Gaussians:
    """A model of a scene, trained at a ratio of rates. Large models grow at smaller gradients."""
    steps, gradient = (500, 2e-4) if count <= 20_000 else (400, 5e-5) if count <= 100_000 else (300, 2e-5)
    growth = {"grow_gradient": gradient, "grow_every": 10 if count > 100_000 else None}
    rates = {"shN_rate": CONSTANT_RATE / ratio, "seed": 7 * count + ratio}
    config = FitConfig(iterations=steps, max_gaussians=count, **rates, **growth)  # type: ignore[arg-type]
    return fit_scene(load_scene(scene, width=width), config, device="cpu").gaussians


def report(name: str, model: Gaussians) -> list[float]:
    """Print a row; returns the z of all detectors."""
    try:
        carriers = Carriers.of(model, Layout.of(model))
    except UsageError as refusal:
        print(f"| {name} | {len(model):,} | refused: {refusal} | | | |", flush=True)
        return []
    found = [each.value for each in steps(model, BitPatterns.of(model)).values()]
    found = [each for each in found if math.isfinite(each)]
    mean, largest = (sum(found) / len(found), max(found)) if found else (math.nan, math.nan)
    allowed = f"{carriers.usable.mean():.2f} | {carriers.depth}"
    print(f"| {name} | {len(model):,} | {allowed} | {mean:+.2f} | {largest:+.1f} |", flush=True)
    return found


if __name__ == "__main__":
    main()
