"""The process that does one job: `python -m keyss.sweeps.worker FOLDER`.

It ends when whoever started it does: its standard input is a pipe that nobody writes to, which ends then. A
job is done when `result.json` is there. Only the holder of the job's lock writes it, after looking that there
is none: two processes that were started for one job do it once.
"""

from __future__ import annotations

import fcntl
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from keyss._processes import end_with_parent
from keyss.core.errors import KeyssError, OutputError
from keyss.files.atomic import write_bytes
from keyss.sweeps.job import FAILED, JOB, LOCK, RESULT, Failure, Job, Result, result_of

REFUSED = 4  # exit status of a job that cannot be done, however often it is tried
INTERRUPTED = 130


def main(arguments: list[str]) -> int:
    """Do the job in the folder that is named; the exit status."""
    from keyss.sweeps.work import perform

    for signum in (signal.SIGINT, signal.SIGTERM):
        signal.signal(signum, _on_signal)
    end_with_parent()
    try:
        return attempt(Path(arguments[0]), perform)
    except KeyboardInterrupt:
        return INTERRUPTED


def attempt(folder: Path, perform: Callable[[Job, Path], Result]) -> int:
    """Do the job unless it is done. What is refused is said on the standard error stream and recorded."""
    from keyss.runs.records import read_record, record_bytes

    with held(folder / LOCK):
        if result_of(folder) is not None:
            return 0
        (folder / FAILED).unlink(missing_ok=True)
        (folder / RESULT).unlink(missing_ok=True)  # its published model is gone
        started = time.strftime("%Y-%m-%d %H:%M:%S")
        print(f"{started} process {os.getpid()} begins", file=sys.stderr, flush=True)
        try:
            result = perform(read_record(folder / JOB, Job), folder)
        except KeyssError as error:
            print(f"error: {error}", file=sys.stderr)
            write_bytes(folder / FAILED, record_bytes(Failure(status=error.exit_status, message=str(error))))
            return REFUSED
        write_bytes(folder / RESULT, record_bytes(result))
        print(f"done in {result.seconds:.1f} s", file=sys.stderr)
        return 0


@contextmanager
def held(path: Path) -> Iterator[None]:
    """Holds a lock file while the block runs, after waiting for whoever holds it; the file stays.

    The system frees it however the process ends. Raises OutputError.
    """
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}") from error
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def _on_signal(signum: int, frame: FrameType | None) -> None:
    for each in (signal.SIGINT, signal.SIGTERM):  # what is saved now is not to be interrupted
        signal.signal(each, signal.SIG_IGN)
    raise KeyboardInterrupt(signum)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
