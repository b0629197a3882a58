"""Processes that keyss starts: what they may take, and that they end with whoever started them.

They run modules of keyss with the same Python. Their standard input is a pipe that stays open for as long as
whoever started them lives.
"""

from __future__ import annotations

import os
import signal
import site
import sys
import sysconfig
import threading
from contextlib import suppress
from pathlib import Path

# Read by the libraries that compute on several threads when they are loaded.
_THREADS = (
    *("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"),
    *("NUMBA_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"),
)
_KEY = "KEYSS_KEY"  # none of these processes reads it
_STARTED = "KEYSS_STARTED_BY_KEYSS"
_ROOT = str(Path(__file__).parents[1])  # where keyss lies
_CGROUPS = Path("/sys/fs/cgroup")


def can_start() -> bool:
    """Whether this process may start others.

    One that keyss has started may not, since it was given so many cores and so much memory; nor can a program
    that is no Python interpreter: a frozen app, or a host that embeds Python.
    """
    python = Path(sys.executable or "").name.lower().startswith("python")
    return python and not getattr(sys, "frozen", False) and _STARTED not in os.environ


def command(module: str) -> tuple[str, ...]:
    """What runs a module of keyss; nothing is imported from the folder that it is started in."""
    return (sys.executable, "-I" if sys.flags.isolated else "-P", "-m", module)


def environment(threads: int) -> dict[str, str]:
    """This process's, with so many threads for whatever computes, and without a key."""
    found = {**os.environ, **dict.fromkeys(_THREADS, str(threads)), _STARTED: "1"}
    found.pop(_KEY, None)
    paths = [each for each in found.get("PYTHONPATH", "").split(os.pathsep) if each]
    # Before the standard library, where a folder of packages must not be.
    if os.path.realpath(_ROOT) not in {os.path.realpath(each) for each in (*paths, *_package_folders())}:
        found["PYTHONPATH"] = os.pathsep.join((_ROOT, *paths))
    return found


def _package_folders() -> list[str]:
    """Where Python looks for packages by itself."""
    found = [sysconfig.get_path("purelib"), sysconfig.get_path("platlib"), *site.getsitepackages()]
    return [*found, site.getusersitepackages()]


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
    """Bytes that could be had now, by this machine and by the control group of a container.

    None where the system does not tell.
    """
    found = _available_in_group()
    with suppress(OSError, KeyError):
        there = _numbers(Path("/proc/meminfo"))["MemAvailable:"] * 1024
        found = there if found is None else min(found, there)
    return found


def _available_in_group() -> int | None:
    """What the limits of control groups (version 2) leave; None without one."""
    found: list[int] = []
    with suppress(OSError, IndexError):
        inside = Path("/proc/self/cgroup").read_text().split("::", 1)[1].splitlines()[0].lstrip("/")
        folder = _CGROUPS / inside
        for group in (folder, *folder.parents[: len(Path(inside).parts)]):
            with suppress(OSError, ValueError, KeyError):  # ValueError: "max", which is no limit
                limit = int((group / "memory.max").read_text())
                used = int((group / "memory.current").read_text())
                found.append(limit - used + _numbers(group / "memory.stat")["inactive_file"])  # is given back
    return max(0, min(found)) if found else None


def _numbers(path: Path) -> dict[str, int]:
    """Of lines that begin with a name and a number. Raises OSError."""
    lines = (line.split() for line in path.read_text().splitlines())
    return {words[0]: int(words[1]) for words in lines if len(words) > 1 and words[1].isdigit()}
