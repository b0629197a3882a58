"""Processes that keyss starts: their command, environment and end, and the resources of this machine.

They run modules of keyss with the same Python. Their standard input is a pipe that closes when the parent
process ends.
"""

from __future__ import annotations

import gc
import os
import signal
import site
import sys
import sysconfig
import threading
from contextlib import suppress
from pathlib import Path

# Read by multithreaded libraries when they are loaded.
_THREADS = (
    *("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"),
    *("NUMBA_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"),
)
_KEY = "KEYSS_KEY"  # not passed on
_STARTED = "KEYSS_STARTED_BY_KEYSS"
_ROOT = str(Path(__file__).parents[1])  # the folder that contains keyss
_CGROUPS = Path("/sys/fs/cgroup")

if _STARTED in os.environ:
    gc.set_threshold(700, 10, 1000)  # as in `keyss.cli.process`


def can_start() -> bool:
    """True if this process may start others.

    False in a process that keyss started, whose cores and memory are limited, and in a program that is not a
    Python interpreter: a frozen app, or a host that embeds Python.
    """
    python = Path(sys.executable or "").name.lower().startswith("python")
    return python and not getattr(sys, "frozen", False) and _STARTED not in os.environ


def command(module: str) -> tuple[str, ...]:
    """The command that runs a module of keyss; it imports nothing from the working folder."""
    return (sys.executable, "-I" if sys.flags.isolated else "-P", "-m", module)


def environment(threads: int) -> dict[str, str]:
    """The environment of this process, for `threads` computing threads, and without a key."""
    variables = {**os.environ, **dict.fromkeys(_THREADS, str(threads)), _STARTED: "1"}
    variables.pop(_KEY, None)
    paths = [path for path in variables.get("PYTHONPATH", "").split(os.pathsep) if path]
    # These come before the standard library, where a folder of packages must not be.
    if os.path.realpath(_ROOT) not in map(os.path.realpath, (*paths, *_package_folders())):
        variables["PYTHONPATH"] = os.pathsep.join((_ROOT, *paths))
    return variables


def _package_folders() -> list[str]:
    """The folders in which Python looks for packages by default."""
    folders = [sysconfig.get_path("purelib"), sysconfig.get_path("platlib"), *site.getsitepackages()]
    return [*folders, site.getusersitepackages()]


def end_with_parent() -> None:
    """End this process when its standard input ends, at once: files appear only when they are complete."""
    threading.Thread(target=_wait_for_parent, daemon=True).start()


def _wait_for_parent() -> None:
    while os.read(0, 1024):
        pass
    os._exit(128 + signal.SIGHUP)


def how_it_ended(status: int) -> str:
    """Describe the exit status of a process without a result."""
    return f"killed by signal {-status}" if status < 0 else f"exit status {status}"


def usable_cores() -> int:
    """The number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def available_memory() -> int | None:
    """Available bytes of this machine and of the control group of a container, None if unknown."""
    available = _available_in_groups()
    with suppress(OSError, KeyError):
        available.append(_numbers(Path("/proc/meminfo"))["MemAvailable:"] * 1024)
    return max(0, min(available)) if available else None


def _available_in_groups() -> list[int]:
    """Bytes below the limit of each control group (version 2) of this process."""
    available: list[int] = []
    with suppress(OSError, IndexError):
        inside = Path("/proc/self/cgroup").read_text().split("::", 1)[1].splitlines()[0].lstrip("/")
        folder = _CGROUPS / inside
        for group in (folder, *folder.parents[: len(Path(inside).parts)]):
            with suppress(OSError, ValueError, KeyError):  # ValueError: "max", no limit
                limit = int((group / "memory.max").read_text())
                used = int((group / "memory.current").read_text())
                cached = _numbers(group / "memory.stat")["inactive_file"]  # the system frees it on demand
                available.append(limit - used + cached)
    return available


def _numbers(path: Path) -> dict[str, int]:
    """Numbers by name, from lines that start with both. Raises OSError."""
    lines = (line.split() for line in path.read_text().splitlines())
    return {words[0]: int(words[1]) for words in lines if len(words) > 1 and words[1].isdigit()}
