"""Processes on a cluster: Ray starts them where cores and memory are free.

Folders and inputs must be reachable under the same paths from every node, as on a shared file system, and its
locks (flock) must hold between nodes. Ray pickles its own tasks; no file of keyss is pickled.
"""

from __future__ import annotations

import os
import warnings
from pathlib import Path
from typing import Any

from keyss.core.errors import BackendError
from keyss.core.extras import import_extra
from keyss.many import processes
from keyss.many.processes import Resources

LOCAL = "local"
_MAX_JOBS = 256  # that Ray has to schedule at once
_POLL = 1.0  # s


class Cluster:
    """A cluster by its address, HOST:PORT, ray://HOST:PORT or auto; or "local", one of this machine's cores.

    Raises BackendError without Ray, and where the cluster cannot be reached.
    """

    jobs, closed = _MAX_JOBS, False

    def __init__(self, address: str, resources: Resources) -> None:
        self.ray, self.resources, self.local = _ray(), resources, address == LOCAL
        options: dict[str, Any] = (
            {"num_cpus": resources.jobs * resources.threads, "include_dashboard": False}
            if self.local
            else {"address": address}
        )
        try:
            self.ray.init(log_to_driver=False, configure_logging=False, **options)
        except Exception as error:  # Ray has no class of its own for what happens while it starts
            raise BackendError(f"cannot reach a Ray cluster at {address}: {error}") from error
        # Retried by `run_cells`, which reports it.
        self.remote = self.ray.remote(max_retries=0)(_attempt)

    def attempt(self, name: str, folder: Path, memory: int) -> int:
        """As `Processes.attempt`. Raises ConnectionError where the worker or its node is gone."""
        threads = self.resources.threads
        reserved = {} if self.local else {"memory": memory}
        chosen = self.remote.options(num_cpus=threads, name=name, **reserved)
        reference = chosen.remote(str(folder), threads, tuple(processes.WORKER))
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


def _attempt(folder: str, threads: int, command: tuple[str, ...]) -> int:
    """On a node: run the cell in a process, which ends with this task; returns its exit status."""
    process = processes.start(Path(folder), threads, command)
    try:
        return process.wait()
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()
        if process.stdin is not None:
            process.stdin.close()


def _ray() -> Any:
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    import_extra("ray.exceptions", "sweep", "run on a cluster")
    return import_extra("ray", "sweep", "run on a cluster")
