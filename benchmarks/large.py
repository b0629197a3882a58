"""Seconds, processor seconds and memory of carrying large models, from files to files.

    python benchmarks/large.py                                # 2 million in 2 million
    python benchmarks/large.py --count 100000 --repeat 3      # the fastest of three
    python benchmarks/large.py --secret-degree 0 --format spz --count 100000 --prune
    python benchmarks/large.py --commands                     # `keyss hide`, pictures and measures included

Each step is a separate process and includes imports, key derivation and reading the secret back; kernels are
compiled before. `floor` reads, hashes, encrypts and writes the bytes of the cover; `copy` reads and writes a
model; `least`, with `--commands`, is `keyss hide` without tests of the cover, encoding and embedding. On a
busy machine, look at processor seconds and their ratio to those of `floor`.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import keyss  # noqa: F401  before torch, see `ruff.toml`

import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from keyss import read_model, write_model
from channels.quiet.trained_like import trained_like
from keyss.channels import LOW_BITS, channel_for
from keyss.methods import embed_models, most_visible, prune_to_size, record_request
from keyss.runs.revealing import reveal_model

KEY = "the key of the benchmark: 7Vw3-Qp"
STEPS = ("floor", "copy", "least", "hide", "reveal")
# The cost without keyss: read, hash, encrypt and write the bytes of the cover.
FLOOR = """
import hashlib, os, sys
from cryptography.hazmat.primitives.ciphers import Cipher, algorithms, modes
data = open(f"{sys.argv[1]}/cover.ply", "rb").read()
digest = hashlib.blake2b(data).digest()
cipher = Cipher(algorithms.AES(digest[:32]), modes.CTR(digest[32:48]))
with open(f"{sys.argv[1]}/floor", "wb") as file:
    file.write(cipher.encryptor().update(data))
    os.fsync(file.fileno())
"""
# `keyss hide` without tests of the cover, encoding and embedding: reads and hashes both models, derives keys
# under 12 salts, for resuming, for randomness and for opening, writes and reads the model, and renders all.
LEAST = """
import sys
from concurrent.futures import ThreadPoolExecutor
from keyss.api import hide as hiding
from keyss.channels import gaussian_ids
from keyss.files.models import read_model, write_model
from keyss.rendering.orbit import scene_of_model
folder = sys.argv[1]
with ThreadPoolExecutor(2) as workers:
    models = list(workers.map(read_model, (f"{folder}/cover.ply", f"{folder}/secret.ply")))
    scenes = [scene_of_model(model, "", train_pictures=False) for model in models]
    list(workers.map(hiding.Gaussians.digest, models))
    list(workers.map(lambda number: hiding.DerivedKey.of("key", bytes([number]) * 16), range(15)))
gaussian_ids(models[0])
write_model(f"{folder}/least.ply", models[0])
models[0] = read_model(f"{folder}/least.ply")
for model, scene in zip(models, scenes):
    hiding.compare(model, model, scene, of_plain=True)
"""


@dataclass(frozen=True)
class Cost:
    """The cost of one process."""

    seconds: float
    processor: float  # seconds of all threads, system time included
    gibibytes: float  # peak memory


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--count", type=int, default=2_000_000, help="Gaussians of the cover, of SH degree 3")
    parser.add_argument(
        "--share", type=float, default=1.0, help="Gaussians of the secret per Gaussian of the cover"
    )
    parser.add_argument("--secret-degree", type=int, default=3, help="SH degree of the secret")
    parser.add_argument("--format", default="ply", choices=["ply", "spz", "sog", "compressed-ply", "any"])
    parser.add_argument("--prune", action="store_true", help="prune the secret to fit")
    parser.add_argument("--repeat", type=int, default=1, help="runs of each step; the fastest counts")
    parser.add_argument("--commands", action="store_true", help="measure the command line")
    parser.add_argument("--step", nargs=2, metavar=("STEP", "FOLDER"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.step:
        _step(options.step[0], Path(options.step[1]), options)
        return
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "key.txt").touch(mode=0o600)
        (folder / "key.txt").write_text(KEY)
        small = folder / "small"
        small.mkdir()
        few = [*_arguments(options), "--count", "2000"]
        for step in ("make", "copy", "hide", "reveal"):  # compiles all kernels
            _run([sys.executable, __file__, "--step", step, str(small), *few])
        if options.commands:
            _run([sys.executable, "-c", LEAST, str(small)])
        _run([sys.executable, __file__, "--step", "make", name, *_arguments(options)])
        steps = [step for step in STEPS if step != "least" or options.commands]
        found = {step: _fastest(step, folder, options) for step in steps}
    print("| step | seconds | processor seconds | of them for each of `floor` | GiB |")
    print("| --- | --- | --- | --- | --- |")
    for step, cost in found.items():
        ratio = cost.processor / found["floor"].processor
        numbers = f"{cost.seconds:.1f} | {cost.processor:.1f} | {ratio:.1f} | {cost.gibibytes:.2f}"
        print(f"| {step} | {numbers} |")


def _fastest(step: str, folder: Path, options: argparse.Namespace) -> Cost:
    if options.commands and step in ("hide", "reveal"):
        command = _command(step, folder, options)
    elif step in ("floor", "least"):
        command = [sys.executable, "-c", FLOOR if step == "floor" else LEAST, str(folder)]
    else:
        command = [sys.executable, __file__, "--step", step, str(folder), *_arguments(options)]
    return min((_run(command) for _ in range(options.repeat)), key=lambda cost: cost.processor)


def _arguments(options: argparse.Namespace) -> list[str]:
    names = ("count", "share", "secret_degree", "format")
    pairs = [part for name in names for part in ("--" + name.replace("_", "-"), str(getattr(options, name)))]
    return [*pairs, "--prune"] if options.prune else pairs


def _command(step: str, folder: Path, options: argparse.Namespace) -> list[str]:
    run, key = [sys.executable, "-m", "keyss", step], ["--key-file", str(folder / "key.txt"), "--overwrite"]
    if step == "hide":
        models = ["--cover", str(folder / "cover.ply"), "--secret", str(folder / "secret.ply")]
        published = ["--publish", "any"] if options.format == "any" else ["--format", options.format]
        carry = ["--method", "carry", *published, *["--refit=never"][: options.prune]]
        return [*run, *carry, *models, *key, "-o", f"{folder}/run"]
    suffix = "ply" if options.format == "any" else options.format.replace("-", ".")
    return [*run, f"{folder}/run/publish/model.{suffix}", *key, "-o", f"{folder}/revealed.ply"]


def _run(command: list[str]) -> Cost:
    """Run a command. Raises SystemExit if it fails."""
    start = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - start
    if code := os.waitstatus_to_exitcode(status):
        raise SystemExit(f"{' '.join(command)}: status {code}")
    kibibytes = usage.ru_maxrss / (1024 if sys.platform == "darwin" else 1)
    return Cost(seconds, usage.ru_utime + usage.ru_stime, kibibytes / 2**20)


def _step(step: str, folder: Path, options: argparse.Namespace) -> None:
    suffix = "ply" if options.format == "any" else options.format.replace("-", ".")
    published = folder / f"stego.{suffix}"
    hidden = max(1, round(options.share * options.count))
    if step == "make":
        write_model(folder / "cover.ply", trained_like(options.count, 0))
        write_model(folder / "secret.ply", trained_like(hidden, 1, options.secret_degree))
    elif step == "copy":
        write_model(folder / "copy.ply", read_model(folder / "cover.ply"))
    elif step == "hide":
        with ThreadPoolExecutor(2) as readers:  # `keyss hide` reads them like this
            cover, secret = readers.map(read_model, (folder / "cover.ply", folder / "secret.ply"))
        if options.format == "ply":
            prepared = LOW_BITS.prepare(cover)
            if options.prune:
                secret = most_visible(
                    secret, prepared.cells.record_capacity([record_request(hidden, secret.sh_degree)])
                )
        else:
            any_format = options.format == "any"
            channel = channel_for("any") if any_format else channel_for("as-is", format=options.format)
            prepared = channel.prepare(cover)
            if options.prune:
                secret = prune_to_size(secret, prepared.capacity.bytes - prepared.capacity.overhead)
        write_model(published, embed_models(prepared, [KEY], [secret]).gaussians)
    else:
        revealed = reveal_model(read_model(published), KEY, device=torch.device("cpu")).gaussians
        write_model(folder / "revealed.ply", revealed)
        print(f"{len(revealed):,} of {hidden:,} Gaussians came out", file=sys.stderr)
        if len(revealed) != hidden and not options.prune:
            raise SystemExit(1)


if __name__ == "__main__":
    main()
