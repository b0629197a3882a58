"""Processes of this machine that run cells, a few at once."""

from __future__ import annotations

import contextlib
import subprocess
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from keyss._processes import available_memory, command, environment, usable_cores
from keyss.core.errors import UsageError
from keyss.many.cell import LOG

WORKER = command("keyss.many.worker")
_PATIENCE = 20.0  # s for cells to save their state when they are interrupted


@dataclass(frozen=True)
class Resources:
    """Jobs at once, and the threads of each."""

    jobs: int  # at once
    threads: int  # of each

    @staticmethod
    def divided(jobs: int | None, memory: int) -> Resources:
        """The cores of this machine, divided among `jobs`; by default as many as cores and memory allow.

        `memory`: bytes of the largest cell. Raises UsageError.
        """
        cores = usable_cores()
        if jobs is None:
            there = available_memory()
            jobs = cores if there is None else max(1, min(cores, there // max(1, memory)))
        if not 1 <= jobs <= 1024:
            raise UsageError(f"`jobs`: expected 1 to 1024, got {jobs}")
        return Resources(jobs, max(1, cores // jobs))


class Processes:
    """Starts a process for each attempt; used from several threads."""

    def __init__(self, resources: Resources) -> None:
        self.resources, self.jobs = resources, resources.jobs
        self._running: list[subprocess.Popen[bytes]] = []
        self._lock = threading.Lock()
        self.closed = False

    def attempt(self, name: str, folder: Path, memory: int) -> int:
        """Run the cell in `folder` in a process, and return its exit status."""
        with self._lock:
            if self.closed:
                return -1
            process = start(folder, self.resources.threads, WORKER)
            self._running.append(process)
        status = process.wait()
        with self._lock:
            self._running.remove(process)
        _close(process)
        return status

    def close(self) -> None:
        """End all processes, after they have saved their state."""
        with self._lock:
            self.closed, running = True, list(self._running)
        for process in running:
            process.terminate()
        deadline = time.monotonic() + _PATIENCE
        for process in running:
            try:
                process.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()


def start(folder: Path, threads: int, worker: Sequence[str]) -> subprocess.Popen[bytes]:
    """Start a process that runs the cell in `folder` and ends with this process. Raises OSError."""
    with (folder / LOG).open("ab") as log:
        return subprocess.Popen(
            [*worker, str(folder)],
            stdin=subprocess.PIPE,
            stdout=log,
            stderr=log,
            env=environment(threads),
            # Ctrl-C in a terminal reaches only this process, which passes on one signal: a second one would
            # interrupt the saving.
            start_new_session=True,
        )


def _close(process: subprocess.Popen[bytes]) -> None:
    if process.stdin is not None:
        with contextlib.suppress(OSError):
            process.stdin.close()
