"""Time, processor time and memory of a command."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass


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
