"""Capacity and cost of carrying, in decibels for your own models. Times: `large.py`.

python benchmarks/carry.py                      # capacities
python benchmarks/carry.py --models FOLDER      # every .ply in it as a cover, and as a secret in the next
python benchmarks/carry.py --photos SCENE=MODEL.ply SCENE=MODEL.ply    # each in the other, against photos
"""

from __future__ import annotations

import argparse
import sys
from itertools import permutations
from pathlib import Path

import keyss  # noqa: F401  before torch, see `ruff.toml`

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from keyss import read_model
from codes import against_photos
from keyss.channels import DEPTHS, TYPICAL_SHARE, Layout, LowBitsCapacity, usable_carriers
from keyss.core import Gaussians, KeyssError, Scene
from keyss.files import load_scene
from keyss.fitting import psnr
from keyss.lab import random_pruning
from keyss.rendering import psnr_between, render
from methods.carry.carried import embed, extract

KEY = "the key of the benchmark"
REMOVED = 0.25


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--models", type=Path)
    parser.add_argument("--photos", nargs="+", default=[])
    parser.add_argument("--width", type=int, default=200)
    arguments = parser.parse_args()
    _capacities()
    if arguments.models:
        _models(sorted(arguments.models.rglob("*.ply")))
    if arguments.photos:
        _photos([pair.split("=", 1) for pair in arguments.photos], arguments.width)


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


def _photos(pairs: list[list[str]], width: int) -> None:
    """Compare with the test photos, before and after removing a quarter of the Gaussians."""
    scenes = {scene: load_scene(scene, width=width) for scene, _ in pairs}
    for (cover, cover_path), (secret, secret_path) in permutations(pairs, 2):
        model, hidden = read_model(cover_path), read_model(secret_path)
        try:
            stego = embed(model, [(KEY, hidden)])
        except KeyssError as error:
            print(f"{secret} in {cover}: {error}", flush=True)
            continue
        found = extract(stego, KEY).gaussians
        kept = random_pruning(REMOVED).apply(stego)
        left = against_photos(extract(kept, KEY).gaussians, scenes[secret])
        whole, bare = against_photos(found, scenes[secret]), against_photos(hidden, scenes[secret])
        before, after = against_photos(model, scenes[cover]), against_photos(kept, scenes[cover])
        cover_change = _between(scenes[cover], model, stego)
        secret_change = _between(scenes[secret], hidden, found)
        print(
            f"{secret} in {cover}:\n"
            f"  cover before and after {cover_change:.1f} dB, "
            f"photos {before:.3f} and {against_photos(stego, scenes[cover]):.3f} dB\n"
            f"  secret and its own model {secret_change:.1f} dB, "
            f"photos {whole:.3f} ({whole - bare:+.3f}) dB\n"
            f"  25 % removed: cover {after - before:+.2f} dB, secret {left - whole:+.2f} dB",
            flush=True,
        )


def _between(scene: Scene, before: Gaussians, after: Gaussians) -> float:
    """The worst view's PSNR."""
    return min(
        psnr(*(render(model, view.camera, scene.background) for model in (before, after)))
        for view in scene.test
    )


if __name__ == "__main__":
    main()
