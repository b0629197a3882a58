"""Failure rates of payloads of the channel `colours` in many formats.

`python benchmarks/colours.py MODEL.ply ... --payloads N --log FILE` appends a line of JSON per payload,
resumes at the end of the file, and prints a table of all lines. Payload i fills model i modulo their number,
under a new key and with new entropy.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from keyss import lab
from keyss.channels import COLOURS, ColoursCover
from keyss.core.errors import BackendError
from keyss.core.gaussians import Gaussians
from keyss.files.models import read_model, write_model
from keyss.rendering.orbit import psnr_between

import numpy as np

Change = Callable[[Gaussians], Gaussians]
Embed = Callable[[ColoursCover, int, bytes], Gaussians]  # cover, number of the key, payload
Opens = Callable[[Gaussians, int, bytes], bool]  # model, number of the key, payload
OWN = (".ply", ".spz", ".compressed.ply", ".sog", ".splat")  # written and read by this library
REMOVED = 0.25  # fraction of the Gaussians


def run_payloads(
    covers: Sequence[tuple[str, Callable[[], Gaussians]]],
    count: int,
    log: Path,
    *,
    foreign: Mapping[str, Change],
    each: int,
    embed: Embed,
    opens: Opens,
) -> None:
    """Run all payloads. `foreign`: formats by other programs, for every `each`-th payload."""
    done = [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []
    prepared: dict[str, ColoursCover] = {}
    for number in range(len(done), count):
        name, read = covers[number % len(covers)]
        if name not in prepared:
            prepared[name] = COLOURS.prepare(read())
        cover, started = prepared[name], time.monotonic()
        data = np.random.default_rng(number).bytes(cover.capacity.bytes - 2)
        stego = embed(cover, number, data)
        opened: dict[str, bool] = {}
        ways: dict[str, Change] = {f"`{suffix}`": _convert_by_keyss(suffix) for suffix in OWN}
        ways |= foreign if number % each == 0 else {}
        for what, change in ways.items():
            try:
                changed = change(stego)
            except BackendError:
                continue
            opened[what] = opens(changed, number, data)
            removed = lab.random_pruning(REMOVED, number)(changed)
            opened[f"{what}, {REMOVED:.0%} removed"] = opens(removed, number, data)
        record = {
            "number": number,
            "model": name,
            "gaussians": len(cover.cover),
            "bytes": len(data),
            "cost": round(psnr_between(cover.cover, stego), 2),
            "seconds": round(time.monotonic() - started, 1),
            "opened": opened,
        }
        done.append(record)
        with log.open("a") as file:
            file.write(json.dumps(record) + "\n")
    print(table(done[:count]))


def _convert_by_keyss(suffix: str) -> Change:
    """Convert to this format and back with keyss."""

    def change(model: Gaussians) -> Gaussians:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"model{suffix}"
            write_model(path, model)
            return read_model(path)

    return change


def table(records: Sequence[Mapping[str, Any]]) -> str:
    """Tables of payloads by model, and failures by format.

    Without failures in n openings, the failure rate is below 3 / n with 95 % confidence (rule of three).
    """
    lines = [
        "| model | Gaussians | payloads | bytes | bits per Gaussian | cost, dB: mean (least) |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for name in dict.fromkeys(each["model"] for each in records):
        own = [each for each in records if each["model"] == name]
        size, gaussians = own[0]["bytes"], own[0]["gaussians"]
        costs = [each["cost"] for each in own]
        lines.append(
            f"| {name} | {gaussians:,} | {len(own)} | {size:,} | {8 * size / gaussians:.2f} "
            f"| {np.mean(costs):.1f} ({min(costs):.1f}) |"
        )
    tries, failures = Counter[str](), Counter[str]()
    for each in records:
        for what, good in each["opened"].items():
            tries[what] += 1
            failures[what] += not good
    lines += ["", "| format | openings | failures | rate below, with 95 % |", "| --- | --- | --- | --- |"]
    for what, count in [*tries.items(), ("all", tries.total())]:
        failed = failures.total() if what == "all" else failures[what]
        lines.append(f"| {what} | {count} | {failed} | {_bound(failed, count):.2%} |")
    return "\n".join(lines)


def _bound(failures: int, count: int) -> float:
    """One-sided 95 % upper bound for a rate (Clopper and Pearson); about 3 / `count` without failures."""
    from scipy.stats import beta

    return float(beta.ppf(0.95, failures + 1, count - failures)) if failures < count else 1.0
