"""The engine of a cluster: Ray starts the same processes, wherever cores and memory are free.

Folders and inputs must be reachable under the same paths from every node, as on a shared file system, and its
locks (flock) must hold between nodes. Ray's own tasks are pickled by Ray; no file of ours is.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from keyss._processes import how_it_ended
from keyss.core.errors import BackendError
from keyss.sweeps.engine import (
    RETRIES,
    WORKER,
    Resources,
    Task,
    Watcher,
    process_of,
)
from keyss.sweeps.worker import REFUSED

LOCAL = "local"
_WAIT = 0.2  # s


@dataclass(frozen=True)
class RayEngine:
    """A cluster by its address, or one of this machine's cores."""

    address: str  # HOST:PORT, ray://HOST:PORT, auto; or "local"
    resources: Resources
    retries: int = RETRIES
    command: Sequence[str] = WORKER

    def run(self, tasks: Sequence[Task], watcher: Watcher) -> None:
        """See `Engine`. Raises BackendError without Ray, and where the cluster cannot be reached."""
        ray = _ray()
        local = self.address == LOCAL
        options: dict[str, Any] = (
            {"num_cpus": self.resources.jobs * self.resources.threads, "include_dashboard": False}
            if local
            else {"address": self.address}
        )
        try:
            ray.init(log_to_driver=False, configure_logging=False, **options)
        except Exception as error:  # Ray has no class of its own for what happens while it starts
            raise BackendError(f"cannot reach a Ray cluster at {self.address}: {error}") from error
        try:
            self._run(ray, tasks, watcher, local)
        finally:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of its own sockets
                ray.shutdown()

    def _run(self, ray: Any, tasks: Sequence[Task], watcher: Watcher, local: bool) -> None:
        # Retried here, where the watcher hears of it.
        remote = ray.remote(max_retries=0)(_attempt)

        def submit(task: Task) -> Any:
            memory = {} if local else {"memory": task.memory}
            threads = self.resources.threads
            chosen = remote.options(num_cpus=threads, name=task.name, **memory)
            return chosen.remote(str(task.folder), threads, tuple(self.command))

        running: dict[Any, tuple[Task, int]] = {}
        for task in tasks:
            watcher.started(task)
            running[submit(task)] = task, 0
        while running:
            ready, _ = ray.wait(list(running), num_returns=1, timeout=_WAIT)
            watcher.tick()
            for reference in ready:
                task, before = running.pop(reference)
                try:
                    status = ray.get(reference)
                    how = how_it_ended(status)
                except ray.exceptions.RayError as error:  # its worker or its node is gone
                    status, how = None, f"lost: {str(error).strip().splitlines()[0]}"
                if status == 0:
                    watcher.done(task)
                elif status == REFUSED:
                    watcher.refused(task)
                else:
                    again = before < self.retries
                    watcher.died(task, how, again)
                    if again:
                        watcher.started(task)
                        running[submit(task)] = task, before + 1


def _attempt(folder: str, threads: int, command: tuple[str, ...]) -> int:
    """On a node: the exit status of a process that does the job. If this is killed, the process ends too."""
    process = process_of(Path(folder), threads, command)
    try:
        return process.wait()
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()
        if process.stdin is not None:
            process.stdin.close()


def _ray() -> Any:
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is told to anybody
    try:
        import ray
        import ray.exceptions
    except ImportError as error:
        raise BackendError(f"`ray` needs the package ray (pip install 'keyss[sweep]'): {error}") from error
    return ray
