"""What every engine does: start a process for each job, again where it died, and tell what happens."""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from keyss._processes import available_memory, command, environment, usable_cores
from keyss.core.errors import UsageError
from keyss.sweeps.job import LOG

RETRIES = 2  # of a job whose process died
WORKER = command("keyss.sweeps.worker")


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


def process_of(folder: Path, threads: int, worker: Sequence[str]) -> subprocess.Popen[bytes]:
    """A process that does the job in `folder`, and that ends when this one does. Raises OSError."""
    with (folder / LOG).open("ab") as log:
        return subprocess.Popen(
            [*worker, str(folder)],
            stdin=subprocess.PIPE,
            stdout=log,
            stderr=log,
            env=environment(threads),
            # Ctrl-C in a terminal reaches only whoever started it, who passes on one signal: at a second one
            # it would not save what it has.
            start_new_session=True,
        )
