"""Processes that keyss starts: what they may take, and that they end with whoever started them.

They run modules of keyss with the same Python. Their standard input is a pipe that stays open for as long as
whoever started them lives.
"""

from __future__ import annotations

import os
import signal
import sys
import sysconfig
import threading
from pathlib import Path

# Read by the libraries that compute on several threads when they are loaded.
_THREADS = (
    *("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"),
    *("NUMBA_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"),
)
_SECRET = "KEYSS_KEY"  # none of these processes reads it
_ROOT = str(Path(__file__).parents[1])  # where keyss lies


def command(module: str) -> tuple[str, ...]:
    """What runs a module of keyss; nothing is imported from the folder that it is started in."""
    return (sys.executable, "-P", "-m", module)


def environment(threads: int) -> dict[str, str]:
    """This process's, with so many threads for whatever computes, and without a key."""
    found = {**os.environ, **dict.fromkeys(_THREADS, str(threads))}
    found.pop(_SECRET, None)
    if _ROOT not in (sysconfig.get_path("purelib"), sysconfig.get_path("platlib")):
        found["PYTHONPATH"] = os.pathsep.join(filter(None, (_ROOT, found.get("PYTHONPATH"))))
    return found


def end_with_parent() -> None:
    """Ends this process at once when its standard input ends, from now on.

    Nothing is lost, for files appear when they are whole.
    """
    threading.Thread(target=_wait_for_parent, daemon=True).start()


def _wait_for_parent() -> None:
    while os.read(0, 1024):
        pass
    os._exit(128 + signal.SIGHUP)


def how_it_ended(status: int) -> str:
    """Of the exit status of a process that left no result."""
    return f"killed by signal {-status}" if status < 0 else f"exit status {status}"


def usable_cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def available_memory() -> int | None:
    """Bytes that could be had now; None where the system does not tell."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return None
    found = {name: int(rest.split()[0]) * 1024 for name, _, rest in (line.partition(":") for line in lines)}
    return found.get("MemAvailable")
