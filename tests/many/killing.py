"""Sweeps whose processes are killed at random moments, and then the same command again."""

from __future__ import annotations

import itertools
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from keyss.core import BackendError
from many.fakes import DRIVER
from other_processes import command_of, descendants, until


def results(out: Path) -> dict[str, tuple[int, int]]:
    """Of each finished cell which file that is, and when it was written."""
    found = {path.parent.name: path.stat() for path in out.glob("cells/*/result.json")}
    return {name: (each.st_ino, each.st_mtime_ns) for name, each in found.items()}


def kill_until_done(
    spec: Path,
    out: Path,
    kind: str,
    kills: int,
    seed: int,
    longest: float,
    chosen: Callable[[str], bool] = lambda command: True,
) -> list[str]:
    """Runs a sweep, kills so many of its processes, then the same command once more.

    No result may change once it is there, and no cell may say twice that it is done. `longest`: between two
    kills, in seconds. `chosen`: whether a process with this command may be killed, beside the driver. The
    commands of those that were.
    """
    rng = random.Random(seed)
    command = [sys.executable, "-c", DRIVER, spec, out, spec.parent / "master.txt", kind]
    seen: dict[str, tuple[int, int]] = {}
    killed: list[str] = []
    for starts in itertools.count():
        last = len(killed) == kills
        with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as driver:
            while len(killed) < kills and driver.poll() is None:
                # The first moments are those of Python's imports: some kills come before anything runs.
                if rng.random() < 0.8:
                    until(lambda driver=driver: _victims(driver.pid, chosen) or driver.poll() is not None)
                time.sleep(rng.uniform(0, longest))
                victim = rng.choice([driver.pid, *_victims(driver.pid, chosen)])
                what = command_of(victim)
                try:
                    os.kill(victim, signal.SIGKILL)
                except ProcessLookupError:
                    continue
                killed.append("driver" if victim == driver.pid else what)
                if victim == driver.pid:
                    break
            _, said = driver.communicate()
        now = results(out)
        assert seen.items() <= now.items()
        assert all(log.read_text().count("done in") <= 1 for log in out.glob("cells/*/log.txt"))
        seen = now
        # A cluster that starts while the one before is still going may not; then the command is typed again.
        no_cluster = driver.returncode == BackendError.exit_status and starts - len(killed) < 5
        assert driver.returncode in (0, -signal.SIGKILL) or (kind == "ray" and no_cluster), said
        assert "Traceback" not in said
        if last and driver.returncode == 0:
            break
    return killed


def _victims(pid: int, chosen: Callable[[str], bool]) -> list[int]:
    return [each for each in descendants(pid) if chosen(command_of(each))]
