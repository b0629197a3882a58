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
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import keyss  # noqa: F401  before torch, see `ruff.toml`
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


@dataclass(frozen=True)
class Job:
    index: int
    scene: str
    cover: str
    others: tuple[str, ...]  # models of the secrets


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("plain", nargs="+", metavar="SCENE=FILE")
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    options = parser.parse_args()
    named = [text.partition("=")[::2] for text in options.plain]
    jobs = [
        Job(index, scene, cover, tuple(other for each, other in named if each != scene))
        for index, (scene, cover) in enumerate(named)
    ]
    started = time.monotonic()
    with ProcessPoolExecutor(options.workers, get_context("fork"), torch.set_num_threads, (1,)) as pool:
        results = list(pool.map(_count_or_skip, jobs))
    jobs, seen = zip(*[each for each in zip(jobs, results, strict=True) if each[1]], strict=True)
    print(f"{len(jobs)} models of {len({job.scene for job in jobs})} scenes, ", end="")
    print(f"{time.monotonic() - started:.0f} s\n")
    print("| detector | AUC | standard error | largest by chance |\n| --- | --- | --- | --- |")
    examples = Examples.of(
        (each[beside], beside, job.scene, job.cover)
        for job, each in zip(jobs, seen, strict=True)
        for beside in (0, 1)
    )
    single, chance = single_detectors(examples, SHOWN)
    for row in learned_detectors(examples):
        print(f"| {row.name} | {row.auc:.3f} | {row.error:.3f} | |")
    for row in single:
        print(f"| {row.name} | {row.auc:.3f} | {row.error:.3f} | {chance:.2f} |")


def _count_or_skip(job: Job) -> list[dict[str, float]] | None:
    """The first holder's statistics, alone and beside others; None for too small covers."""
    try:
        return _count(job)
    except UsageError as error:
        print(f"{job.cover}: {error}", file=sys.stderr)
        return None


def _count(job: Job) -> list[dict[str, float]]:
    random = np.random.default_rng(job.index)
    cover = read_model(job.cover)
    secrets = [
        most_visible(read_model(path), int(random.integers(len(cover) // (2 * SHARE), len(cover) // SHARE)))
        for path in random.choice(job.others, 1 + MAX_OTHERS)
    ]
    found = []
    for count in (1, 1 + int(random.integers(1, MAX_OTHERS + 1))):
        stego = embed(cover, [(str(index), secret) for index, secret in enumerate(secrets[:count])])
        statistics = {name: each.value for name, each in stealth_statistics(stego).items()}
        found.append(seen_by_holder(stego, "0") | statistics)
    return found


if __name__ == "__main__":
    main()
