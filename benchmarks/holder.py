"""Detection of other secrets by the holder of one key, on your own models.

    python benchmarks/holder.py bonsai=a.ply bonsai=b.ply fox=c.ply ...   # plain, of three scenes or more

In each model, a secret is hidden alone and beside one to three others. The holder opens it, tries every shard
of the file with the key (`tests/channels/lsb/holder.py`), and computes the statistics of
`keyss.lab.stealth`. Detectors are cross-validated over scenes.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

from keyss.files import read_model

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from channels.lsb.holder import seen_by_holder
from keyss.core import UsageError
from keyss.lab import stealth_statistics
from keyss.methods import most_visible
from methods.carry.carried import embed
from stealth_detection import Examples, learned_detectors, single_detectors

MAX_OTHERS = 3
SHARE = 8  # secrets have at most 1 / SHARE of the cover's Gaussians
SHOWN = 3  # single statistics in the table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("plain", nargs="+", metavar="SCENE=FILE")
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    options = parser.parse_args()
    named = [text.partition("=")[::2] for text in options.plain]
    others = [[other for each, other in named if each != scene] for scene, _ in named]
    started = time.monotonic()
    with ProcessPoolExecutor(options.workers, get_context("fork"), torch.set_num_threads, (1,)) as pool:
        seen = list(pool.map(_count_or_skip, range(len(named)), [cover for _, cover in named], others))
    counted = [each for each in zip(named, seen, strict=True) if each[1]]
    print(f"{len(counted)} models of {len({scene for (scene, _), _ in counted})} scenes, ", end="")
    print(f"{time.monotonic() - started:.0f} s\n")
    print("| detector | AUC | standard error | largest by chance |\n| --- | --- | --- | --- |")
    examples = Examples.of(
        (each[beside], beside, scene, cover) for (scene, cover), each in counted for beside in (0, 1)
    )
    single, chance = single_detectors(examples, SHOWN)
    for row in learned_detectors(examples):
        print(f"| {row.name} | {row.auc:.3f} | {row.error:.3f} | |")
    for row in single:
        print(f"| {row.name} | {row.auc:.3f} | {row.error:.3f} | {chance:.2f} |")


def _count_or_skip(index: int, path: str, others: list[str]) -> list[dict[str, float]] | None:
    """The first holder's statistics, alone and beside others; None for too small covers."""
    random = np.random.default_rng(index)
    cover = read_model(path)
    secrets = [
        most_visible(read_model(other), int(random.integers(len(cover) // (2 * SHARE), len(cover) // SHARE)))
        for other in random.choice(others, 1 + MAX_OTHERS)
    ]
    found = []
    for count in (1, 1 + int(random.integers(1, MAX_OTHERS + 1))):
        try:
            stego = embed(cover, [(str(number), secret) for number, secret in enumerate(secrets[:count])])
        except UsageError as error:
            print(f"{path}: {error}", file=sys.stderr)
            return None
        statistics = {name: each.value for name, each in stealth_statistics(stego).items()}
        found.append(seen_by_holder(stego, "0") | statistics)
    return found


if __name__ == "__main__":
    main()
