"""Engines for many runs: sequentially in this process, or in parallel on a Ray cluster.

Every node must have folders and inputs under the same paths. Ray pickles tasks between its own processes;
keyss writes no pickles.
"""

from __future__ import annotations

import os
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import Any

from keyss.core import BackendError, Interrupted, KeyssError, OutputError, UsageError, import_extra
from keyss.files import lock
from keyss.progress import Reporter, reporter as default_reporter
from keyss.runs.folder import PRIVATE, check_not_published, make_private

_LOCAL = "local"  # a cluster of this machine


Tasks = Mapping[Path, Any]  # tasks by folder; each has a `name` and a `device`
Work = Callable[[Any, Path, Reporter], Any]  # runs a task in a folder; returns its result
Ended = tuple[Path, Any, str | None]  # folder of a task, its result, and an error
Engine = Callable[[Work, Tasks], Iterator[Ended]]  # runs tasks, in any order


@contextmanager
def engine(ray: str | None, cores: int, reporter: Reporter | None) -> Iterator[Engine]:
    """An engine. `ray`: HOST:PORT, ray://HOST:PORT, auto, or local for a cluster on this machine; None: here.

    `cores`: cores per task on Ray. An error of one task does not stop the others. Raises BackendError if the
    cluster cannot be reached, UsageError.
    """
    if cores < 1:
        raise UsageError(f"`cores`: expected at least 1, got {cores}")
    reporter = reporter or default_reporter()
    with nullcontext(partial(_in_process, reporter)) if ray is None else _cluster(ray, cores) as run:

        def running(work: Work, tasks: Tasks) -> Iterator[Ended]:
            for number, (folder, result, error) in enumerate(run(work, tasks), start=1):
                reporter.note(
                    f"[{number}/{len(tasks)}] {tasks[folder].name}: {'failed' if error else 'done'}"
                )
                yield folder, result, error

        yield running


@contextmanager
def claim_folder(out: Path, mode: int = 0o700) -> Iterator[None]:
    """Create the folder if necessary, and lock it while the block runs.

    Raises OutputError, also for folders inside `publish/`.
    """
    check_not_published(out)
    try:
        out.mkdir(parents=True, exist_ok=True, mode=mode)
    except OSError as error:
        raise OutputError(f"cannot write {out}: {error.strerror}") from error
    make_private(out / PRIVATE)
    with lock(out / PRIVATE / "lock", out):
        yield


def _in_process(reporter: Reporter, work: Work, tasks: Tasks) -> Iterator[Ended]:
    for folder, task in tasks.items():
        try:
            ended = _attempt(work, task, folder, reporter)
        except Interrupted as error:  # its message says how to resume a single run
            reporter.note("interrupted: the same command resumes")
            raise KeyboardInterrupt(*error.args) from error
        yield ended


def _attempt(work: Work, task: Any, folder: Path, reporter: Reporter | None = None) -> Ended:
    """Run one task; an error becomes a result."""
    try:
        return folder, work(task, folder, reporter or default_reporter()), None
    except (KeyssError, OSError) as error:
        return folder, None, str(error)
    except Exception as error:  # e.g. a GPU out of memory
        traceback.print_exc()
        return folder, None, f"{type(error).__name__}: {error}"


@contextmanager
def _cluster(address: str, cores: int) -> Iterator[Engine]:
    """Ray, which retries tasks of lost processes and nodes."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    ray = import_extra("ray", "sweep", "run on a cluster")
    where = {"include_dashboard": False} if address == _LOCAL else {"address": address}
    variables = {name: str(cores) for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS")}
    try:
        ray.init(log_to_driver=False, runtime_env={"env_vars": variables}, **where)
    except Exception as error:  # Ray raises many kinds of errors while it connects
        raise BackendError(f"cannot reach a Ray cluster at {address}: {error}") from error

    def run(work: Work, tasks: Tasks) -> Iterator[Ended]:
        remote, running = ray.remote(_attempt), {}
        for folder, task in tasks.items():
            chosen = remote.options(name=task.name, num_cpus=cores, num_gpus=int(task.device == "cuda"))
            running[chosen.remote(work, task, folder.absolute())] = folder
        while running:
            (done,), _ = ray.wait(list(running))
            folder = running.pop(done)
            try:
                yield (folder, *ray.get(done)[1:])
            except ray.exceptions.RayError as error:
                yield folder, None, f"lost by Ray: {str(error).strip().splitlines()[0]}"

    try:
        yield run
    finally:
        ray.shutdown()
