"""Runs the command line and checks its output."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import cheap_keys
from files.scene_files import write_blender, write_nerfstudio
from keyss.cli import entry
from keyss.fitting import ImageQuality
from keyss.measure import BaselineQuality, RenderFidelity
from keyss.runs import HideMetrics

METRICS = HideMetrics(
    method="carry",
    cover=ImageQuality(30.0, 0.5),
    secrets=(ImageQuality(20.0, 0.25),),
    baseline=BaselineQuality(ImageQuality(30.5, 0.6), (None,), (1234, None), (10, 10), (True, False)),
    wrong_key=None,
    chance_level=(9.0,),
    gaussians=1234,
    photos=(True, True),
    secret_gaussians=(567,),
    secret_degrees=((3, 3),),
    iterations=10,
    steps=(10, 20),
    seconds=1.0,
    width=100,
    seed=0,
    against_plain=(RenderFidelity(32.0, 8.0), RenderFidelity(31.0, 9.0)),
    details={"capacity": 1000, "bits_per_gaussian": [568, 600]},
)
SMALL = ("--preset", "quick", "--iterations", "20", "--max-gaussians", "100", "--device", "cpu")
COMMANDS = list(entry.MODULES)
PROGRAM = [sys.executable, "-c", cheap_keys.PROGRAM]


class Result(NamedTuple):
    """Exit status and output of a command."""

    status: int
    out: str
    err: str


Run = Callable[..., Result]  # the type of the fixture `keyss`


def write_key(path: Path, key: str = "q7Rv2LxT9bWm4KzD") -> Path:
    """Write a private key file."""
    path.touch(0o600)
    path.write_text(f"{key}\n")
    return path


def write_workspace(folder: Path) -> Path:
    """Scenes `a` and `b`, and `key.txt`."""
    write_blender(folder / "a", count=3, channels=3)
    write_nerfstudio(folder / "b", count=4)
    write_key(folder / "key.txt")
    return folder


def scene_arguments(workspace: Path) -> tuple[object, ...]:
    """Arguments of `hide` that hide scene b in a."""
    return "--cover", workspace / "a", "--secret", workspace / "b", "--key-file", workspace / "key.txt"


def listing(folder: Path) -> dict[str, int]:
    """All files and folders with their modification times."""
    return {str(path.relative_to(folder)): path.lstat().st_mtime_ns for path in sorted(folder.rglob("*"))}


def assert_refused(result: Result, status: int, words: str) -> None:
    """Assert the exit status, and one or two lines of errors that contain `words`."""
    assert result.status == status, result.err
    assert words in result.err
    assert result.err.startswith("keyss: ")
    assert 1 <= len(result.err.splitlines()) <= 2
    assert "Traceback" not in result.err
    assert result.out == ""


def start_handling(arguments: Sequence[object], folder: Path | None = None) -> subprocess.Popen[str]:
    """Start a command in a process, and wait until it handles signals or has ended."""
    command, pipe = [*PROGRAM, *map(str, arguments)], subprocess.PIPE
    process = subprocess.Popen(
        command, cwd=folder, stdin=subprocess.DEVNULL, stdout=pipe, stderr=pipe, text=True
    )
    status = Path(f"/proc/{process.pid}/status")
    # The last handler that is installed; nohup ignores SIGHUP.
    last = next(each for each in (signal.SIGHUP, signal.SIGTERM) if signal.getsignal(each) != signal.SIG_IGN)
    if not status.exists():
        time.sleep(0.5)
    while status.exists() and process.poll() is None:
        caught = next(line for line in status.read_text().splitlines() if line.startswith("SigCgt"))
        if int(caught.split()[1], 16) >> (last - 1) & 1:
            break
        time.sleep(0.001)
    return process
