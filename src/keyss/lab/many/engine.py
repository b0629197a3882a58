"""Run tasks one after the other in this process, or in parallel on a Ray cluster.

Every node must have folders and inputs under the same paths. Ray pickles tasks between its own processes;
keyss writes no pickles.
"""

from __future__ import annotations

import os
import traceback
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from keyss.core import BackendError, Interrupted, KeyssError, OutputError, UsageError, import_extra
from keyss.files import lock
from keyss.progress import Reporter, reporter as default_reporter
from keyss.runs.folder import PRIVATE, check_not_published, make_private

_LOCAL = "local"  # a cluster of this machine

Tasks = Mapping[Path, Any]  # tasks by folder; each has a `name` and a `device`
Work = Callable[[Any, Path, Reporter], Any]  # runs a task in a folder; returns its result


@dataclass(frozen=True)
class Outcome:
    """The outcome of a task."""

    name: str
    folder: Path
    result: Any = None
    error: str | None = None  # the reason for a missing result
    skipped: bool = False  # True if it was finished before


@dataclass(frozen=True)
class ManyResult:
    """The outcomes of all tasks, in their order."""

    outcomes: tuple[Outcome, ...]
    tables: tuple[str, ...] = ()  # names of files in the folder

    @property
    def errors(self) -> dict[str, str]:
        """Errors of failed tasks, by name."""
        return {each.name: each.error for each in self.outcomes if each.error is not None}


def run_tasks(
    work: Work,
    tasks: Tasks,
    needs: Mapping[Path, Collection[Path]] | None = None,
    *,
    ray: str | None = None,
    cores: int = 1,
    reporter: Reporter | None = None,
) -> Iterator[Outcome]:
    """Run tasks; yields their outcomes, in any order. An error of one task does not stop the others.

    `needs`: by task, earlier tasks without which it fails. `ray`: HOST:PORT, ray://HOST:PORT, auto, or local
    for a cluster on this machine; None: this process. `cores`: cores per task on Ray. Raises BackendError if
    the cluster cannot be reached, UsageError.
    """
    if cores < 1:
        raise UsageError(f"`cores`: expected at least 1, got {cores}")
    if not tasks:
        return
    reporter, needed = reporter or default_reporter(), needs or {}
    outcomes = (
        _in_process(work, tasks, needed, reporter)
        if ray is None
        else _on_ray(work, tasks, needed, ray, cores)
    )
    for number, outcome in enumerate(outcomes, start=1):
        reporter.note(f"[{number}/{len(tasks)}] {outcome.name}: {'failed' if outcome.error else 'done'}")
        yield outcome


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


def _in_process(
    work: Work, tasks: Tasks, needs: Mapping[Path, Collection[Path]], reporter: Reporter
) -> Iterator[Outcome]:
    ended: dict[Path, Outcome] = {}
    for folder, task in tasks.items():
        needed = [ended[each] for each in needs.get(folder, ()) if each in ended]
        try:
            ended[folder] = _attempt(work, task, folder, reporter, *needed)
        except Interrupted as error:  # its message says how to resume a single run
            reporter.note("interrupted: the same command resumes")
            raise KeyboardInterrupt(*error.args) from error
        yield ended[folder]


def _attempt(work: Work, task: Any, folder: Path, reporter: Reporter | None, *needed: Outcome) -> Outcome:
    """Run one task; an error becomes a part of its outcome."""
    outcome = Outcome(task.name, folder)
    if failed := [each.error for each in needed if each.error]:
        return replace(outcome, error=failed[0])
    try:
        return replace(outcome, result=work(task, folder, reporter or default_reporter()))
    except (KeyssError, OSError) as error:
        return replace(outcome, error=str(error))
    except Exception as error:  # e.g. a GPU out of memory
        traceback.print_exc()
        return replace(outcome, error=f"{type(error).__name__}: {error}")


def _on_ray(
    work: Work, tasks: Tasks, needs: Mapping[Path, Collection[Path]], address: str, cores: int
) -> Iterator[Outcome]:
    """Ray starts a task when those that it needs have ended, and repeats tasks of lost nodes."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    ray = import_extra("ray", "sweep", "run on a cluster")
    where = {"include_dashboard": False} if address == _LOCAL else {"address": address}
    variables = {name: str(cores) for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS")}
    try:
        ray.init(log_to_driver=False, runtime_env={"env_vars": variables}, **where)
    except Exception as error:  # Ray raises many kinds of errors while it connects
        raise BackendError(f"cannot reach a Ray cluster at {address}: {error}") from error
    try:
        attempt = ray.remote(_attempt)
        started: dict[Path, Any] = {}
        for folder, task in tasks.items():
            chosen = attempt.options(name=task.name, num_cpus=cores, num_gpus=int(task.device == "cuda"))
            needed = [started[each] for each in needs.get(folder, ()) if each in started]
            started[folder] = chosen.remote(work, task, folder.absolute(), None, *needed)
        running = {each: folder for folder, each in started.items()}
        while running:
            (done,), _ = ray.wait(list(running))
            folder = running.pop(done)
            try:
                yield replace(ray.get(done), folder=folder)
            except ray.exceptions.RayError as error:
                reason = f"lost by Ray: {str(error).strip().splitlines()[0]}"
                yield Outcome(tasks[folder].name, folder, error=reason)
    finally:
        ray.shutdown()
