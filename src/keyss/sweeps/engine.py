"""What every engine does: start a process for each job, again where it died, and tell what happens."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from keyss.core.errors import UsageError
from keyss.sweeps.job import LOG

RETRIES = 2  # of a job whose process died
WORKER = (sys.executable, "-m", "keyss.sweeps.worker")

# Read by the libraries that compute on several threads when they are loaded.
_THREADS = (
    *("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"),
    *("NUMBA_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"),
)


@dataclass(frozen=True)
class Task:
    """A job that is to be done."""

    name: str
    folder: Path
    memory: int  # bytes that it will take, roughly


@dataclass(frozen=True)
class Resources:
    """What jobs may take."""

    jobs: int  # at once
    threads: int  # of each

    @staticmethod
    def divided(jobs: int | None, memory: int) -> Resources:
        """The cores of this machine, divided among `jobs`; by default as many as cores and memory allow.

        `memory`: bytes of the largest job. Raises UsageError.
        """
        cores = usable_cores()
        if jobs is None:
            there = available_memory()
            jobs = cores if there is None else max(1, min(cores, there // max(1, memory)))
        if not 1 <= jobs <= 1024:
            raise UsageError(f"`jobs`: expected 1 to 1024, got {jobs}")
        return Resources(jobs, max(1, cores // jobs))


class Watcher(Protocol):
    """Is told what happens, in the order in which it does."""

    def started(self, task: Task) -> None:
        """An attempt begins."""

    def died(self, task: Task, how: str, again: bool) -> None:
        """Its process is gone without a result; `again`: another attempt will be made."""

    def done(self, task: Task) -> None:
        """There is a result."""

    def refused(self, task: Task) -> None:
        """It cannot be done; `failed.json` says why."""

    def tick(self) -> None:
        """Some time has passed."""


class Engine(Protocol):
    """Does jobs, in any order."""

    def run(self, tasks: Sequence[Task], watcher: Watcher) -> None:
        """Returns when each is done, was refused, or has died once more than it may."""


def process_of(folder: Path, threads: int, command: Sequence[str]) -> subprocess.Popen[bytes]:
    """A process that does the job in `folder`, and that ends when this one does. Raises OSError."""
    with (folder / LOG).open("ab") as log:
        return subprocess.Popen(
            [*command, str(folder)],
            stdin=subprocess.PIPE,
            stdout=log,
            stderr=log,
            env=environment(threads),
            # Ctrl-C in a terminal reaches only whoever started it, who passes on one signal: at a second one
            # it would not save what it has.
            start_new_session=True,
        )


def environment(threads: int) -> Mapping[str, str]:
    """This process's, with so many threads for whatever computes."""
    return {**os.environ, **dict.fromkeys(_THREADS, str(threads))}


def how_it_ended(status: int) -> str:
    """Of the exit status of a process that left no result."""
    return f"killed by signal {-status}" if status < 0 else f"exit status {status}"


def usable_cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def available_memory() -> int | None:
    """Bytes that could be had now; None where the system does not tell."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return None
    found = {name: int(rest.split()[0]) * 1024 for name, _, rest in (line.partition(":") for line in lines)}
    return found.get("MemAvailable")
