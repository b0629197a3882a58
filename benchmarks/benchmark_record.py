"""Records of benchmark runs as JSON files, and comparison of two records.

A record names the commit and the machine. Its *numbers* are absolute (seconds, bytes, decibels; the name ends
in the unit) and valid on that machine only. Its *ratios* compare keyss with a fixed workload on the same
machine at the same time, or parts of keyss with each other: they are comparable between days. Less is better
for every ratio.

Records are `benchmarks/results/NAME/COMMIT.json`; `make benchmark-check` compares with `baseline.json` beside
them.
"""

from __future__ import annotations

import os
import platform
import subprocess
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path

from keyss.files import write_bytes

import msgspec

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"


@dataclass(frozen=True)
class Machine:
    """The machine of a benchmark."""

    processor: str
    cores: int
    system: str
    python: str
    libraries: dict[str, str]  # versions by name


@dataclass(frozen=True, kw_only=True)
class BenchmarkRecord:
    """One run of one benchmark."""

    version: int = 1
    name: str
    commit: str  # 12 hexadecimal digits, then `-changed` if files differed from it
    machine: Machine
    numbers: dict[str, float] = field(default_factory=dict)
    ratios: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Change:
    """A changed ratio; None if a record lacks it."""

    ratio: str
    before: float | None
    now: float | None

    def __str__(self) -> str:
        if self.before is None or self.now is None:
            return f"{self.ratio}: {'no longer measured' if self.now is None else 'not in the baseline'}"
        factor = self.now / self.before
        return f"{self.ratio}: {self.now:.3g}, {factor:.2f} times the baseline's {self.before:.3g}"


def make_record(name: str, numbers: dict[str, float], ratios: dict[str, float]) -> BenchmarkRecord:
    """A record of this commit on this machine."""
    return BenchmarkRecord(
        name=name, commit=this_commit(), machine=this_machine(), numbers=numbers, ratios=ratios
    )


def write_record(record: BenchmarkRecord, path: Path | None = None) -> Path:
    """Write `record` to `path`, by default `benchmarks/results/NAME/COMMIT.json`; returns the path."""
    path = path or RESULTS / record.name / f"{record.commit}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, msgspec.json.format(msgspec.json.encode(record), indent=2) + b"\n")
    return path


def read_record(path: Path) -> BenchmarkRecord:
    """Read a record. Raises msgspec.ValidationError for other files, OSError without a file."""
    return msgspec.json.decode(path.read_bytes(), type=BenchmarkRecord)


def regressions(now: BenchmarkRecord, baseline: BenchmarkRecord, tolerance: float) -> list[Change]:
    """Ratios that grew by more than the share `tolerance`, and those missing in one of the records."""
    names = sorted(now.ratios.keys() | baseline.ratios.keys())
    changes = [Change(name, baseline.ratios.get(name), now.ratios.get(name)) for name in names]
    return [
        change
        for change in changes
        if change.before is None or change.now is None or change.now > change.before * (1 + tolerance)
    ]


def numbers_of_table(titles: list[str], rows: list[list[str]], labels: int = 2) -> dict[str, float]:
    """The first number in each cell of a table, by the row's first `labels` cells and the column's title."""
    return {
        f"{', '.join(row[:labels])}: {title}": float(cell.split()[0])
        for row in rows
        for title, cell in list(zip(titles, row, strict=True))[labels:]
    }


def this_commit() -> str:
    """The checked-out commit; `unknown` outside a repository."""
    digits, changed = _git("rev-parse", "--short=12", "HEAD"), _git("status", "--porcelain", "-uno")
    return "unknown" if not digits else digits + ("-changed" if changed else "")


def this_machine() -> Machine:
    """The current machine."""
    libraries = {name: version(name) for name in ("numba", "numpy", "torch")}
    system = f"{platform.system()} {platform.machine()}"
    return Machine(processor_name(), os.cpu_count() or 1, system, platform.python_version(), libraries)


def processor_name() -> str:
    """The system's name for the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def _git(*arguments: str) -> str:
    try:
        done = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        return ""
    return done.stdout.strip()
