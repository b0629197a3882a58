"""What a sweep of independent cells takes one after the other, and on all cores.

    python benchmarks/sweep.py               # 8 cells
    python benchmarks/sweep.py --cells 4 --count 2000
    python benchmarks/sweep.py --ray         # on a local cluster of Ray, too

Each cell is a process of its own that carries a secret in a cover, draws both and measures them. `serial` is
one after the other on one core, `one at a time` the same with all cores for each, `all cores` as many at once
as there are cores. Nothing else should run beside it.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

import keyss
from keyss import write_model
from channels.low_bits.trained_like import trained_like
from keyss._processes import usable_cores
from keyss.many import ManyResult

SPEC = """\
pairs:
  - {cover: cover.ply, secrets: [secret.ply]}
methods:
  - {method: carry, options: {prune_to_fit: true}}
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--cells", type=int, default=8)
    parser.add_argument("--count", type=int, default=10_000, help="Gaussians of the cover and of the secret")
    parser.add_argument("--ray", action="store_true", help="on a local cluster of Ray, too")
    options = parser.parse_args()
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_setaffinity") else None
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_model(folder / "cover.ply", trained_like(options.count, 0))
        write_model(folder / "secret.ply", trained_like(options.count // 2, 1))
        spec = folder / "sweep.yaml"
        spec.write_text(SPEC + "seeds: [0]\n")
        _seconds(spec, folder / "first", 1)  # kernels are compiled then
        spec.write_text(SPEC + f"seeds: {list(range(options.cells))}\n")
        found = {}
        if cores is not None:
            os.sched_setaffinity(0, cores[:1])
            found["serial"] = _seconds(spec, folder / "serial", 1)
            os.sched_setaffinity(0, cores)
        found["one at a time"] = _seconds(spec, folder / "one", 1)
        found["all cores"] = _seconds(spec, folder / "all", usable_cores())
        if options.ray:
            found["all cores, Ray"] = _seconds(spec, folder / "ray", usable_cores(), ray="local")
    first = next(iter(found))
    print(f"{options.cells} cells, {usable_cores()} cores\n")
    print(f"| | seconds | of `{first}` |\n| --- | --- | --- |")
    for what, seconds in found.items():
        print(f"| {what} | {seconds:.1f} | {seconds / found[first]:.2f} |")


def _seconds(spec: Path, out: Path, jobs: int, ray: str | None = None) -> float:
    """Raises SystemExit where a cell failed."""
    start = time.perf_counter()
    found = keyss.sweep(spec, out, jobs=jobs, ray=ray)
    if isinstance(found, ManyResult) and found.failed:
        raise SystemExit(f"{len(found.failed)} cells failed: {found.failed[0].error}")
    return time.perf_counter() - start


if __name__ == "__main__":
    main()
