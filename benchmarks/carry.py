"""Capacity and cost of carrying, in decibels for your own models. Times: `large.py`.

python benchmarks/carry.py                      # capacities
python benchmarks/carry.py --models FOLDER      # every .ply in it as a cover, and as a secret in the next
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from keyss import read_model
from keyss.channels import DEPTHS, TYPICAL_SHARE, Layout, LowBitsCapacity, usable_carriers
from keyss.core import KeyssError
from keyss.rendering import psnr_between
from methods.carry.carried import embed, extract

KEY = "the key of the benchmark"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--models", type=Path)
    arguments = parser.parse_args()
    _capacities()
    if arguments.models:
        _models(sorted(arguments.models.rglob("*.ply")))


def _capacities() -> None:
    print("Bytes of a payload per Gaussian, of 100,000 of which three quarters are usable, by depth:")
    for degree in range(4):
        for quats in (True, False):
            layout, carriers = Layout(degree, quats), int(TYPICAL_SHARE * 100_000)
            sizes = [
                LowBitsCapacity(100_000, carriers, layout, depth).payload_capacity(1) for depth in DEPTHS
            ]
            name = "" if quats else ", unit quaternions"
            print(f"  degree {degree}{name}: " + ", ".join(f"{size / 100_000:.1f}" for size in sizes))


def _models(paths: list[Path]) -> None:
    """Compare renders of each cover and secret with those of the stego model and the revealed secret."""
    models = {path: read_model(path) for path in paths}
    for cover, secret in zip(paths, paths[1:] + paths[:1], strict=True):
        try:
            usable = usable_carriers(models[cover])
            stego = embed(models[cover], [(KEY, models[secret])])
        except KeyssError as error:
            print(f"{cover}: {error}")
            continue
        carried = extract(stego, KEY)
        print(
            f"{cover} ({len(stego):,}, {usable.mean():.0%} usable) carries {secret} "
            f"({len(carried.gaussians):,}): cover {psnr_between(models[cover], stego):.1f} dB, "
            f"secret and its own model {psnr_between(models[secret], carried.gaussians):.1f} dB",
            flush=True,
        )


if __name__ == "__main__":
    main()
