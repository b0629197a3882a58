"""Damaged model files: each has to end in a model or in an InputError, soon and in little memory.

    python benchmarks/mutations.py --count 100000
    python benchmarks/mutations.py --count 10000 --only a.payload   # what a key opens, written by an attacker

Files of every format are damaged at random, before and after they are packed: bits, bytes, words with
extreme values, cuts, repeats, megabytes of zeros. What is not as it should be is printed with the seed that
repeats it.
"""

from __future__ import annotations

import argparse
import gzip
import io
import resource
import sys
import time
import zipfile
from dataclasses import replace

from keyss.core import Gaussians, InputError
from keyss.files import model_bytes, model_of_bytes
from keyss.files.formats.spz import SpzCodes
from keyss.methods.records import whole

import numpy as np
import torch

SECONDS = 2.0  # that one file of a few kilobytes may take
CARRIERS = 6000  # Gaussians of the published model that holds a payload
ROOM = 2 << 30  # bytes that all of them may take beside what the program has
_EXTREMES = (0, 1, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 0x7F800000, 0x7FC00000, 0x3F800000, 0x10000, 0xFF)


def examples(count: int = 60) -> dict[str, list[bytes]]:
    """Small files of each format, by a name that ends as they do."""
    generator = torch.Generator().manual_seed(0)

    def model(degree: int) -> Gaussians:
        shapes = ((3,), (4,), (3,), (), ((degree + 1) ** 2, 3))
        return Gaussians(*(torch.randn(count, *shape, generator=generator) for shape in shapes))

    names = ("a.ply", "a.compressed.ply", "a.spz", "a.sog", "a.glb", "a.splat")
    found = {name: [model_bytes(name, model(degree)) for degree in (0, 2)] for name in names}
    found["a.spz"].append(replace(SpzCodes.quantise(model(1)), version=4).serialise())
    found["a.payload"] = [whole.encode(model(degree)) for degree in range(4)]
    return found


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """`data`, damaged in one of many ways, inside or outside of what packs it."""
    if rng.random() < 0.7:
        if data.startswith(b"\x1f\x8b"):
            return gzip.compress(_damaged(gzip.decompress(data), rng), 1)
        if data.startswith(b"PK"):
            return _damaged_archive(data, rng)
    return _damaged(data, rng)


def _damaged_archive(data: bytes, rng: np.random.Generator) -> bytes:
    """A ZIP archive one of whose files is damaged."""
    found = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(found, "w") as new:
        names = old.namelist()
        chosen = "meta.json" if rng.random() < 0.5 else names[rng.integers(len(names))]
        for name in names:
            content = old.read(name)
            new.writestr(name, _damaged(content, rng) if name == chosen else content)
    return found.getvalue()


def _damaged(data: bytes, rng: np.random.Generator) -> bytes:
    found = bytearray(data)
    for _ in range(rng.integers(1, 4)):
        # Headers are short, and most of what can go wrong is in them.
        end = len(found) if rng.random() < 0.4 else min(len(found), 128)
        at = int(rng.integers(0, max(1, end)))
        match int(rng.integers(0, 7)):
            case 0:
                found[at : at + 1] = bytes([rng.integers(0, 256)])
            case 1:
                found[at : at + 1] = bytes([(found[at] if at < len(found) else 0) ^ 1 << rng.integers(0, 8)])
            case 2:
                found[at : at + 4] = int(rng.choice(_EXTREMES)).to_bytes(4, "little")
            case 3:
                del found[at:]
            case 4:
                found[at:at] = found[at : at + int(rng.integers(1, 64))]
            case 5:
                digits = b"0", b"1", b"9", b"-1", b"1e999", b"99999999999999999999", b"null", b"{}", b"[]"
                found[at : at + 1] = digits[rng.integers(len(digits))]
            case 6:
                found += bytes(int(rng.integers(0, 4)) << 20)
    return bytes(found)


def attempt(name: str, data: bytes) -> str | None:
    """What is wrong with how a file is read, if anything."""
    start = time.perf_counter()
    try:
        model = whole.decode(data, CARRIERS) if name == "a.payload" else model_of_bytes(name, data)
        finite = all(bool(value.isfinite().all()) for value in vars(model).values())
        problem = None if finite and len(model) else "a model that is empty or not finite"
    except InputError as error:
        problem = None if len(str(error)) < 1000 else "a message without end"
    except Exception as error:
        problem = f"{type(error).__name__}: {error}"
    seconds = time.perf_counter() - start
    return problem or (f"{seconds:.1f} s" if seconds > SECONDS else None)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", help="name of one kind of file")
    asked = parser.parse_args()
    files = [(name, data) for name, every in examples().items() for data in every]
    files = [(name, data) for name, data in files if asked.only in (None, name)]
    for name, data in files:
        assert attempt(name, data) is None, name
    with open("/proc/self/statm") as file:
        have = int(file.read().split()[0]) * resource.getpagesize()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    resource.setrlimit(resource.RLIMIT_AS, (have + ROOM, have + ROOM))
    failures, start = 0, time.perf_counter()
    for number in range(asked.count):
        name, data = files[number % len(files)]
        rng = np.random.default_rng([asked.seed, number])
        mutated = damaged(data, rng)
        if problem := attempt(name, mutated):
            failures += 1
            print(f"{name}, seed {asked.seed}, number {number}: {problem}", flush=True)
        if number % 10_000 == 9_999:
            print(f"{number + 1:,} files, {time.perf_counter() - start:.0f} s", file=sys.stderr, flush=True)
    used = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    print(
        f"{asked.count:,} files of {len(files)}: {failures} not as they should be, {used:,.0f} MiB of memory"
    )
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
