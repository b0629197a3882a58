"""Detection of hidden content by the attacks of `keyss.lab.stealth`, on your own models.

    python benchmarks/stealth.py bonsai=a.ply bonsai=b.ply fox=c.ply ...  # plain, of three scenes or more
    python benchmarks/stealth.py ... --fine-tuned bonsai=stego.ply:secret.ply  # files, secrets' models
    python benchmarks/stealth.py --pairs bonsai=plain.ply:stego.ply ...     # given files
    python benchmarks/stealth.py ... --quick     # two random parts of each model, no candidates

Each plain model is made to carry as much of a model of the next scene as fits, and random bytes. Statistics
are computed for complete models and for parts of 2,000 to 5,000 Gaussians, random ones and pieces of space.
Detectors are cross-validated over scenes.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

from keyss.files import read_model

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from channels.lsb.payloads import embed
from keyss.channels import LOW_BITS
from keyss.core import Gaussians, UsageError
from keyss.fitting import FitConfig
from keyss.lab import stealth_statistics
from keyss.methods.carry.carry_method import CarryCapacity
from keyss.rendering import Viewpoints
from lab.stealth.candidates import candidate_scores
from methods.carry import carried
from stealth_detection import Examples, confirmed, learned_detectors, single_detectors

PART_SIZES = (2000, 5000)
PAYLOAD_BYTES = 4000
CANDIDATES = 24
SHOWN = 8  # single statistics in the table


@dataclass(frozen=True)
class File:
    """One file to judge; `pair` names the plain model from which it was made."""

    kind: str  # "plain", "carried", "payload" (random bytes), "fine-tuned" or "given"
    scene: str
    pair: str
    model: Gaussians
    secret: str = ""


def main() -> None:
    options = _arguments()
    started = time.monotonic()
    with ProcessPoolExecutor(options.workers, get_context("fork"), torch.set_num_threads, (1,)) as pool:
        files = [file for made in pool.map(_make, *_jobs(options)) for file in made]
        for scene, path, given in map(_parse_named, options.pairs):
            files.append(File("plain", scene, path, read_model(path)))
            files.append(File("given", scene, path, read_model(given)))
        print(f"{len(files)} files after {time.monotonic() - started:.0f} s", file=sys.stderr)
        for scene, path, secret in map(_parse_named, options.fine_tuned):
            files.append(File("fine-tuned", scene, path, read_model(path), secret))
        pieces = [(file, name, piece) for file in files for name, piece in _pieces(file, options.quick)]
        rows = list(pool.map(_statistics, [piece for _, _, piece in pieces], chunksize=4))
        print(f"{len(rows)} pieces after {time.monotonic() - started:.0f} s", file=sys.stderr)
        scenes, plain = {file.scene for file in files}, sum(file.kind == "plain" for file in files)
        print(f"{plain} plain models of {len(scenes)} scenes, {time.monotonic() - started:.0f} s\n")
        _print_detections(files, pieces, rows)
        if not options.quick:
            print("\n| confirmation | score | true above another |\n| --- | --- | --- |")
            _print_confirmations(pool, files)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("plain", nargs="*", metavar="SCENE=FILE")
    parser.add_argument("--fine-tuned", nargs="*", default=[], metavar="SCENE=FILE:SECRET")
    parser.add_argument("--pairs", nargs="*", default=[], metavar="SCENE=PLAIN:STEGO")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    return parser.parse_args()


def _parse_named(text: str) -> tuple[str, str, str]:
    """Parse scene, file, and the file after a colon."""
    scene, _, paths = text.partition("=")
    first, _, second = paths.partition(":")
    return scene, first, second


def _jobs(options: argparse.Namespace) -> tuple[range, list[str], list[str], list[str]]:
    """Numbers, scenes, plain models, and models of another scene, each time different if there are enough."""
    plain = [_parse_named(text)[:2] for text in options.plain]
    secrets = []
    for index, (scene, _) in enumerate(plain):
        others = [path for named, path in plain if named != scene]
        secrets.append(others[(7 * index + 3) % len(others)])
    return range(len(plain)), [scene for scene, _ in plain], [path for _, path in plain], secrets


def _make(index: int, scene: str, path: str, hidden: str) -> list[File]:
    """The plain model, and files that hide something; nothing for a cover that hiding refuses."""
    cover = read_model(path)
    made = [File("plain", scene, path, cover)]
    try:
        capacity = CarryCapacity.of(LOW_BITS, cover, FitConfig())
    except UsageError as error:
        print(f"{path} is left out: {error}", file=sys.stderr)
        return []
    whole = read_model(hidden)
    (secret,) = capacity.prune([whole], [Viewpoints.around(whole)])
    stego = carried.embed(cover, [("a key", secret)])
    made.append(File("carried", scene, path, stego, hidden))
    with suppress(UsageError):  # a small model has no room for a payload
        payload = embed(cover, [("a key", os.urandom(PAYLOAD_BYTES))])
        made.append(File("payload", scene, path, payload))
    return made


def _pieces(file: File, quick: bool) -> Iterable[tuple[str, Gaussians]]:
    """The model and two to four disjoint parts of it, equal for all files of a pair.

    `quick`: only the first two random parts.
    """
    yield "whole", file.model
    count = len(file.model)
    random = np.random.default_rng([ord(letter) for letter in file.pair])
    parts = min(int(random.integers(2, 5)), count // PART_SIZES[0])
    if parts < 2:
        return
    for rows in np.array_split(random.permutation(count), parts)[: 2 if quick else None]:
        yield "random", file.model[torch.from_numpy(np.sort(rows)[: PART_SIZES[1]])]
    if quick:
        return
    axis = int((file.model.means.quantile(0.9, 0) - file.model.means.quantile(0.1, 0)).argmax())
    for rows in np.array_split(file.model.means[:, axis].numpy().argsort(kind="stable"), parts):
        yield "space", file.model[torch.from_numpy(np.sort(rows)[: PART_SIZES[1]])]


def _statistics(piece: Gaussians) -> dict[str, float]:
    return {name: each.value for name, each in stealth_statistics(piece).items()}


def _print_detections(
    files: Sequence[File], pieces: Sequence[tuple[File, str, Gaussians]], rows: Sequence[dict[str, float]]
) -> None:
    """Print classifiers and the best single detectors, by kind and piece."""
    print("| files | detector | AUC | standard error | pooled | largest by chance |")
    print("| --- | --- | --- | --- | --- | --- |")
    for kind in dict.fromkeys(file.kind for file in files if file.kind != "plain"):
        paired = {file.pair for file in files if file.kind == kind}
        for piece in ("whole", "random", "space"):
            own = [
                (file, row)
                for (file, name, _), row in zip(pieces, rows, strict=True)
                if name == piece
                and (
                    file.kind == kind
                    or (file.kind == "plain" and (kind == "fine-tuned" or file.pair in paired))
                )
            ]
            if len({file.scene for file, _ in own}) < 3 or len({file.kind for file, _ in own}) < 2:
                continue
            examples = Examples.of((row, int(file.kind == kind), file.scene, file.pair) for file, row in own)
            single, chance = single_detectors(examples, SHOWN)
            table = [(row, "") for row in learned_detectors(examples)]
            for row, limit in [*table, *((row, f"{chance:.2f}") for row in single)]:
                numbers = f"{row.auc:.3f} | {row.error:.3f} | {row.pooled:.3f} | {limit}"
                print(f"| {kind}, {piece} | {row.name} | {numbers} |")


def _print_confirmations(pool: ProcessPoolExecutor, files: Sequence[File]) -> None:
    """Print by kind and score the probability that the true candidate ranks above another one."""
    for kind in ("carried", "fine-tuned"):
        own = [file for file in files if file.kind == kind and file.secret]
        own = own[:: max(1, -(-len(own) // CANDIDATES))]
        paths = list(dict.fromkeys(file.secret for file in own))
        if len(paths) < 2:
            continue
        cases = [(file.model, candidate) for file in own for candidate in map(read_model, paths)]
        scores = list(pool.map(candidate_scores, *zip(*cases, strict=True), chunksize=4))
        true = [paths.index(file.secret) for file in own]
        found = {
            name: confirmed(np.array([score[name] for score in scores]).reshape(len(own), len(paths)), true)
            for name in scores[0]
            if all(name in score for score in scores)
        }
        for name, value in sorted(found.items(), key=lambda pair: -abs(pair[1] - 0.5)):
            print(f"| {kind}, {len(own)} files, {len(paths)} candidates | {name} | {value:.3f} |")


if __name__ == "__main__":
    main()
