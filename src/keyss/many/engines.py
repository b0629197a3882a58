"""Engines that run cells: in this process, in others of this machine, or on a cluster.

On a cluster Ray starts processes where cores and memory are free. Folders and inputs must be reachable under
the same paths from every node, as on a shared file system, and its locks (flock) must hold between nodes. Ray
pickles its own tasks; no file of keyss is pickled.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import threading
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from keyss._processes import available_memory, command, environment, usable_cores
from keyss.core.errors import BackendError, UsageError, import_extra
from keyss.many.cell import LOG
from keyss.many.worker import attempt
from keyss.progress import Reporter

WORKER = command("keyss.many.worker")
_PATIENCE = 20.0  # s for cells to save their state when they are interrupted
_LOCAL = "local"  # a cluster of this machine's cores
_MAX_JOBS = 256  # that Ray has to schedule at once
_POLL = 1.0  # s


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
        try:
            return process.wait()
        finally:
            with self._lock:
                self._running.remove(process)
            _close(process)

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


class Cluster:
    """A cluster by its address, HOST:PORT, ray://HOST:PORT or auto; or "local", one of this machine's cores.

    Raises BackendError without Ray, and where the cluster cannot be reached.
    """

    jobs, closed = _MAX_JOBS, False

    def __init__(self, address: str, resources: Resources) -> None:
        self.ray, self.resources, self.local = _ray(), resources, address == _LOCAL
        options: dict[str, Any] = (
            {"num_cpus": resources.jobs * resources.threads, "include_dashboard": False}
            if self.local
            else {"address": address}
        )
        try:
            self.ray.init(log_to_driver=False, configure_logging=False, **options)
        except Exception as error:  # Ray raises many kinds of errors while it connects
            raise BackendError(f"cannot reach a Ray cluster at {address}: {error}") from error
        # Retried by `run_cells`, which reports it.
        self.remote = self.ray.remote(max_retries=0)(_attempt)

    def attempt(self, name: str, folder: Path, memory: int) -> int:
        """See `Processes.attempt`. Raises ConnectionError if the worker or its node is gone."""
        threads = self.resources.threads
        reserved = {} if self.local else {"memory": memory}
        chosen = self.remote.options(num_cpus=threads, name=name, **reserved)
        reference = chosen.remote(str(folder), threads, tuple(WORKER))
        try:
            while not self.ray.wait([reference], timeout=_POLL)[0]:
                if self.closed:
                    return -1
            status: int = self.ray.get(reference)
        except self.ray.exceptions.RayError as error:
            raise ConnectionError(str(error).strip().splitlines()[0]) from error
        return status

    def close(self) -> None:
        """Leave the cluster and end its running cells."""
        self.closed = True
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of its own sockets
            self.ray.shutdown()


class InThisProcess:
    """Runs one cell after the other, with a reporter."""

    jobs, closed = 1, False

    def __init__(self, reporter: Reporter) -> None:
        self.reporter = reporter

    def attempt(self, name: str, folder: Path, memory: int) -> int:
        """See `Processes.attempt`."""
        from keyss.many.performing import perform

        return attempt(folder, partial(perform, reporter=self.reporter), log=False)

    def close(self) -> None:
        pass


Engine = Processes | Cluster | InThisProcess


def start(folder: Path, threads: int, worker: Sequence[str]) -> subprocess.Popen[bytes]:
    """Start a process that runs the cell in `folder` and ends with this process. Raises OSError."""
    with (folder / LOG).open("ab") as log:
        return subprocess.Popen(
            [*worker, str(folder)],
            stdin=subprocess.PIPE,
            stdout=log,
            stderr=log,
            env=environment(threads),
            # Ctrl-C in a terminal reaches only this process, which forwards a single signal, because a second
            # one would interrupt saving.
            start_new_session=True,
        )


def _close(process: subprocess.Popen[bytes]) -> None:
    if process.stdin is not None:
        with contextlib.suppress(OSError):
            process.stdin.close()


def _attempt(folder: str, threads: int, command: tuple[str, ...]) -> int:
    """On a node: run the cell in a process, which ends with this task; returns its exit status."""
    process = start(Path(folder), threads, command)
    try:
        return process.wait()
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()
        _close(process)


def _ray() -> Any:
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    import_extra("ray.exceptions", "sweep", "run on a cluster")
    return import_extra("ray", "sweep", "run on a cluster")
