"""From jobs to their ends: what is done is left alone, what is not goes to an engine."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from keyss.core.errors import OutputError
from keyss.files.atomic import write_bytes
from keyss.files.lock import lock
from keyss.runs.records import record_bytes
from keyss.sweeps.board import Board
from keyss.sweeps.cluster import RayEngine
from keyss.sweeps.engine import RETRIES, WORKER, Engine, Resources, Task
from keyss.sweeps.job import FAILED, JOB, Failure, Job, Result, failure_of, result_of
from keyss.sweeps.local import LocalEngine

PRIVATE = "private"
_BASE_BYTES = 800_000_000  # of a process that has loaded all it needs
_MODEL_COPIES = 12  # of the models it reads, in bytes of their files


@dataclass(frozen=True)
class Planned:
    """A job with its place."""

    job: Job
    folder: Path
    memory: int  # bytes, roughly

    @staticmethod
    def of(job: Job, folder: Path) -> Planned:
        sizes = (Path(each) for each in job.inputs)
        models = sum(each.stat().st_size for each in sizes if each.is_file())
        return Planned(job, folder, _BASE_BYTES + _MODEL_COPIES * models)


@dataclass(frozen=True)
class Ended:
    """What became of a job: one of the two, or none where its process died."""

    name: str
    folder: Path
    result: Result | None
    failure: Failure | None
    skipped: bool = False  # was done before


@dataclass(frozen=True)
class How:
    """Where and how jobs run."""

    jobs: int | None = None  # at once; None: as many as cores and memory allow
    ray: str | None = None  # address of a cluster, or "local"
    retries: int = RETRIES
    command: Sequence[str] | None = None  # of the process that does a job; None: `keyss.sweeps.worker`

    def engine(self, planned: Sequence[Planned]) -> Engine:
        """Raises UsageError."""
        resources = Resources.divided(self.jobs, max((each.memory for each in planned), default=1))
        command = WORKER if self.command is None else self.command
        if self.ray is not None:
            return RayEngine(self.ray, resources, self.retries, command)
        return LocalEngine(resources, self.retries, command)


def run_all(title: str, planned: Sequence[Planned], how: How) -> list[Ended]:
    """Do all jobs that are not done, in a folder that is `claimed`; what became of each.

    Raises OutputError and BackendError.
    """
    before = [result_of(each.folder) for each in planned]
    due = [each for each, result in zip(planned, before, strict=True) if result is None]
    for each in due:
        _prepare(each)
    tasks = [Task(each.job.name, each.folder, each.memory) for each in due]
    if tasks:
        with Board(title, len(planned), len(planned) - len(tasks)) as board:
            how.engine(due).run(tasks, board)
    return [
        Ended(
            each.job.name,
            each.folder,
            result or result_of(each.folder),
            failure_of(each.folder),
            result is not None,
        )
        for each, result in zip(planned, before, strict=True)
    ]


def claimed(out: Path, work: Callable[[], list[Ended]]) -> list[Ended]:
    """`work` while this process holds the folder's lock. Raises OutputError."""
    make_private(out / PRIVATE)
    with lock(out / PRIVATE / "lock"):
        return work()


def make_private(folder: Path) -> None:
    """A folder that others cannot read. Raises OutputError."""
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        folder.chmod(0o700)
    except OSError as error:
        raise OutputError(f"cannot write {folder}: {error.strerror}") from error


def _prepare(planned: Planned) -> None:
    make_private(planned.folder)
    with suppress(FileNotFoundError):
        (planned.folder / FAILED).unlink()  # the next attempt tells
    write_bytes(planned.folder / JOB, record_bytes(planned.job))
