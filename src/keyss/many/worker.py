"""The process that runs one cell: `python -m keyss.many.worker FOLDER`.

It ends with its parent, which holds the other end of its standard input. A cell is done when
`result.json` exists. Only the holder of the cell's lock writes it, after checking that there is none, so a
cell runs only once even if two processes were started for it.
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
from keyss.many.cell import CELL, FAILED, LOCK, RESULT, Cell, Failure, Result, result_of

REFUSED = 4  # exit status of a cell that cannot be done, however often it is tried
INTERRUPTED = 130


def main(arguments: list[str]) -> int:
    """Run the cell in the given folder; returns the exit status."""
    from keyss.many.performing import perform

    for signum in (signal.SIGINT, signal.SIGTERM):
        signal.signal(signum, _on_signal)
    end_with_parent()
    try:
        return attempt(Path(arguments[0]), perform)
    except KeyboardInterrupt:
        return INTERRUPTED


def attempt(folder: Path, perform: Callable[[Cell, Path], Result], *, log: bool = True) -> int:
    """Run the cell unless it is done, and record a refusal; returns the exit status.

    `log`: print to the standard error stream.
    """
    from keyss.runs.records import read_record, record_bytes

    def say(line: str) -> None:
        if log:
            print(line, file=sys.stderr, flush=True)

    with _held(folder / LOCK):
        cell = read_record(folder / CELL, Cell)
        if result_of(folder, cell.measures) is not None:
            return 0
        (folder / FAILED).unlink(missing_ok=True)
        say(f"{time.strftime('%Y-%m-%d %H:%M:%S')} process {os.getpid()} begins")
        try:
            result = perform(cell, folder)
        except KeyssError as error:
            say(f"error: {error}")
            write_bytes(folder / FAILED, record_bytes(Failure(message=str(error))))
            return REFUSED
        write_bytes(folder / RESULT, record_bytes(result))
        say(f"done in {result.seconds:.1f} s")
        return 0


@contextmanager
def _held(path: Path) -> Iterator[None]:
    """Hold a lock file while the block runs, after waiting for its holder; the file stays.

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
    for each in (signal.SIGINT, signal.SIGTERM):  # a second signal must not interrupt the saving
        signal.signal(each, signal.SIG_IGN)
    raise KeyboardInterrupt(signum)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
