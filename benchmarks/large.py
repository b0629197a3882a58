"""Seconds, processor seconds and memory of hiding and revealing large models.

    python benchmarks/large.py                                # 2 million in 2 million
    python benchmarks/large.py --count 100000 --repeat 3      # the fastest of three
    python benchmarks/large.py --count 100000 --share 0.1 --secret-degree 0 --format spz

Measures `keyss hide` and `keyss reveal` of synthetic models, imports, key derivation, files and measurements
included, and divides by a *floor*: one process that reads cover and secret, hashes them (SHA-256), encrypts
one (ChaCha20-Poly1305) and writes it. "22 % lost" reveals from a random 78 % of the published Gaussians. A
file of 10 kB compares with `keyss convert`, which reads and writes the cover. Kernels are compiled before.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import keyss  # noqa: F401  before torch, see `ruff.toml`

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from keyss import read_model, write_model
from channels.lsb.trained_like import trained_like

import torch

SUFFIXES = {"ply": "ply", "spz": "spz", "sog": "sog", "compressed-ply": "compressed.ply", "converted": "ply"}


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
    print("| command | seconds | over the floor | processor seconds | GiB |")
    print("| --- | --- | --- | --- | --- |")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "key.txt").touch(mode=0o600)
        (folder / "key.txt").write_text("the key of the benchmark: 7Vw3-Qp")
        (folder / "letter.bin").write_bytes(os.urandom(10_000))
        for count in (3000, options.count):  # the first run compiles
            hidden = max(1, round(options.share * count))
            apart(make, folder / "cover.ply", count, 0, 3)
            apart(make, folder / "secret.ply", hidden, 1, options.secret_degree)
            floor = 0.0
            for step, command in commands(folder, options.format).items():
                if "lost" in step:
                    apart(lose, folder / "run/publish/model.ply", folder / "lost.ply")
                costs = [run(command) for _ in range(options.repeat if count == options.count else 1)]
                best = min(costs, key=lambda cost: cost.processor)
                floor = floor or best.seconds
                if count == options.count:
                    numbers = f"{best.seconds:.1f} | {best.seconds / floor:.1f} | {best.processor:.1f}"
                    print(f"| {step} | {numbers} | {best.gibibytes:.2f} |", flush=True)
            found = len(read_model(folder / "revealed.ply"))
            if found != hidden and count == options.count:  # a small cover has room for fewer
                raise SystemExit(f"{found:,} of {hidden:,} Gaussians were revealed")


def apart(function: Callable[..., None], *arguments: Any) -> None:
    """Call `function` in a process of its own: the memory of this one counts as that of each command."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        pool.submit(function, *arguments).result()


def make(out: Path, count: int, seed: int, sh_degree: int) -> None:
    write_model(out, trained_like(count, seed, sh_degree))


def lose(published: Path, out: Path) -> None:
    """Write a published model without 22 % of its Gaussians."""
    model = read_model(published)
    left = torch.rand(len(model), generator=torch.Generator().manual_seed(2)) > 0.22
    write_model(out, model[left])


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


FLOOR = """
import hashlib, os, sys
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305
cover, secret = (open(path, "rb").read() for path in sys.argv[1:3])
hashlib.sha256(cover).digest(), hashlib.sha256(secret).digest()
with open(sys.argv[3], "wb") as file:
    file.write(ChaCha20Poly1305(bytes(32)).encrypt(bytes(12), secret, b""))
    os.fsync(file.fileno())
"""


def commands(folder: Path, format: str) -> dict[str, list[Any]]:
    """The measured commands by name, the floor first."""
    program, key = [sys.executable, "-m", "keyss"], ["--key-file", folder / "key.txt", "--overwrite"]
    published = ["--publish", "converted"] if format == "converted" else ["--format", format]
    cover, secret = folder / "cover.ply", folder / "secret.ply"
    models = ["--cover", cover, "--secret", secret, "--fine-tune", "never"]
    stego = folder / "run/publish" / f"model.{SUFFIXES[format]}"
    found = {
        "floor": [sys.executable, "-c", FLOOR, cover, secret, folder / "floor"],
        "convert": [*program, "convert", cover, "-o", folder / "copy.ply", "--overwrite"],
        "hide": [*program, "hide", *models, *published, *key, "-o", folder / "run"],
        "info": [*program, "info", folder / "cover.ply"],
        "verify": [*program, "verify", stego],
        "reveal": [*program, "reveal", stego, *key, "-o", folder / "revealed.ply"],
    }
    if format in ("ply", "converted"):
        lost = folder / "lost.ply"
        found["reveal, 22 % lost"] = [*program, "reveal", lost, *key, "-o", folder / "revealed.ply"]
    file = ["--cover", cover, "--secret-file", folder / "letter.bin", *published, *key]
    found["hide a file of 10 kB"] = [*program, "hide", *file, "-o", folder / "file"]
    return found


if __name__ == "__main__":
    main()
