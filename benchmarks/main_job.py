"""Time of one hiding, from photos to measurements, against an older commit.

    python benchmarks/main_job.py --cover bonsai --secret fox --against 2f752b1

Runs `keyss hide` in alternating processes of the working tree and the older commit. Each tree first hides for
a few steps, to compile its kernels.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
KEY = "Xq7Rf2LmZ9aT+001"
FEW = 60  # steps
LIBRARIES = ("OMP", "MKL", "NUMBA")  # libraries with threads: prefixes of their settings

Command = list[object]
Times = tuple[float, float]  # seconds and processor seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--cover", type=Path, required=True)
    parser.add_argument("--secret", type=Path, required=True)
    parser.add_argument("--against", metavar="COMMIT")
    parser.add_argument("--width", type=int, default=200)
    parser.add_argument("--max-gaussians", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--iterations", type=int, help="by default, each commit's own")
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--repeats", type=int, default=2)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        found = hidings(options, Path(name))
    steps = f"{options.iterations} steps" if options.iterations else "each commit's own number of steps"
    print(f"{steps}, {options.threads} thread(s); the least of {options.repeats}\n")
    print("| | seconds | processor seconds |\n| --- | --- | --- |")
    for what, times in found.items():
        print(f"| {what} | {min(each[0] for each in times):.1f} | {min(each[1] for each in times):.1f} |")


def hidings(options: argparse.Namespace, folder: Path) -> dict[str, list[Times]]:
    """Times of complete hidings by tree."""
    (folder / "key.txt").write_text(KEY)
    scenes = ["--cover", options.cover.resolve(), "--secret", options.secret.resolve()]
    job = ["hide", *scenes, "--key-file", folder / "key.txt", *sizes(options)]
    found: dict[str, list[Times]] = {}
    with older_tree(options.against, folder / "older") as older:
        trees = {"hide, this tree": ROOT, **older}
        for what, tree in trees.items():
            few = ["--iterations", FEW, "--min-psnr", 0, "-o", folder / f"first, {what}"]
            time_command(tree, [*job, *few], options.threads)
        for number in range(options.repeats):
            for what, tree in trees.items():
                out = folder / f"{number}, {what}"
                steps = ["--iterations", options.iterations] if options.iterations else []
                found.setdefault(what, []).append(
                    time_command(tree, [*job, *steps, "-o", out], options.threads)
                )
                print(f"{what}: {decibels(out)}", flush=True)
    return found


def decibels(run: Path) -> str:
    """PSNR of the cover and the secret of a hiding."""
    metrics = json.loads(next(run.rglob("metrics.json")).read_text())
    cover, secret = metrics["cover"]["psnr"], metrics["secrets"][0]["psnr"]
    return f"cover {cover:.2f} dB, secret {secret:.2f} dB"


def sizes(options: argparse.Namespace) -> Command:
    return ["--width", options.width, "--max-gaussians", options.max_gaussians, "--seed", options.seed]


@contextmanager
def older_tree(commit: str | None, place: Path) -> Iterator[dict[str, Path]]:
    """Check out a commit; yields its folder by the name of its hidings, or nothing without a commit."""
    if commit is None:
        yield {}
        return
    git = ["git", "-C", ROOT, "worktree"]
    subprocess.run([*git, "add", "--detach", place, commit], check=True)
    try:
        yield {f"hide, {commit}": place}
    finally:
        subprocess.run([*git, "remove", "--force", place], check=True)


def time_command(tree: Path, command: Command, threads: int) -> Times:
    """Time a command of a tree's `keyss`. Raises CalledProcessError if it fails."""
    environment = os.environ | {f"{library}_NUM_THREADS": str(threads) for library in LIBRARIES}
    environment["PYTHONPATH"] = str(tree / "src")
    before, start = processor_seconds(), time.perf_counter()
    line = [sys.executable, "-m", "keyss", *map(str, command)]
    subprocess.run(line, env=environment, cwd=tree, check=True)
    return time.perf_counter() - start, processor_seconds() - before


def processor_seconds() -> float:
    """Processor time of this process and its finished children."""
    return sum(os.times()[:4])


if __name__ == "__main__":
    main()
