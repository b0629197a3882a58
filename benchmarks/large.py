"""Seconds, processor seconds and memory of hiding and revealing large models.

    python benchmarks/large.py                                 # 2 million in 2 million
    python benchmarks/large.py --count 100000 --repeat 3       # the fastest of three
    python benchmarks/large.py --count 100000 --share 0.1 --secret-degree 0 --format spz

Measures `keyss hide` and `keyss reveal` of synthetic models, imports, key derivation, files and measurements
included; `keyss convert` only reads and writes the cover. Kernels are compiled before.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import keyss  # noqa: F401  before torch, see `ruff.toml`

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from keyss import read_model, write_model
from channels.quiet.trained_like import trained_like

SUFFIXES = {"ply": "ply", "spz": "spz", "sog": "sog", "compressed-ply": "compressed.ply", "any": "ply"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--count", type=int, default=2_000_000, help="Gaussians of the cover, of SH degree 3")
    parser.add_argument(
        "--share", type=float, default=1.0, help="Gaussians of the secret per Gaussian of the cover"
    )
    parser.add_argument("--secret-degree", type=int, default=3, help="SH degree of the secret")
    parser.add_argument("--format", default="ply", choices=SUFFIXES)
    parser.add_argument("--repeat", type=int, default=1, help="runs of each step; the fastest counts")
    options = parser.parse_args()
    print("| command | seconds | processor seconds | GiB |")
    print("| --- | --- | --- | --- |")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "key.txt").touch(mode=0o600)
        (folder / "key.txt").write_text("the key of the benchmark: 7Vw3-Qp")
        for count in (3000, options.count):  # the first run compiles
            hidden = max(1, round(options.share * count))
            write_model(folder / "cover.ply", trained_like(count, 0))
            write_model(folder / "secret.ply", trained_like(hidden, 1, options.secret_degree))
            for step, command in commands(folder, options.format).items():
                costs = [run(command) for _ in range(options.repeat if count == options.count else 1)]
                best = min(costs, key=lambda cost: cost.processor)
                if count == options.count:
                    numbers = f"{best.seconds:.1f} | {best.processor:.1f} | {best.gibibytes:.2f}"
                    print(f"| {step} | {numbers} |", flush=True)
            found = len(read_model(folder / "revealed.ply"))
            if found != hidden:
                raise SystemExit(f"{found:,} of {hidden:,} Gaussians were revealed")


@dataclass(frozen=True)
class Cost:
    """The cost of one process."""

    seconds: float
    processor: float  # seconds of all threads, system time included
    gibibytes: float  # peak memory


def run(command: Sequence[object], environment: Mapping[str, str] | None = None) -> Cost:
    """Run a command with additional environment variables. Raises SystemExit if it fails."""
    words, start = [str(word) for word in command], time.perf_counter()
    process = subprocess.Popen(words, stdout=subprocess.DEVNULL, env={**os.environ, **(environment or {})})
    _, status, usage = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - start
    if code := os.waitstatus_to_exitcode(status):
        raise SystemExit(f"{' '.join(words)}: status {code}")
    kibibytes = usage.ru_maxrss / (1024 if sys.platform == "darwin" else 1)
    return Cost(seconds, usage.ru_utime + usage.ru_stime, kibibytes / 2**20)


def commands(folder: Path, format: str) -> dict[str, list[object]]:
    """The measured commands, by name."""
    program, key = [sys.executable, "-m", "keyss"], ["--key-file", folder / "key.txt", "--overwrite"]
    published = ["--publish", "any"] if format == "any" else ["--format", format]
    models = ["--cover", folder / "cover.ply", "--secret", folder / "secret.ply", "--refit", "never"]
    stego = folder / "run/publish" / f"model.{SUFFIXES[format]}"
    return {
        "convert": [*program, "convert", folder / "cover.ply", folder / "copy.ply", "--overwrite"],
        "hide": [*program, "hide", *models, *published, *key, "-o", folder / "run"],
        "info": [*program, "info", folder / "cover.ply"],
        "verify": [*program, "verify", stego],
        "reveal": [*program, "reveal", stego, *key, "-o", folder / "revealed.ply"],
    }


if __name__ == "__main__":
    main()
