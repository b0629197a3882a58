"""What tests of the command line run and compare."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import cheap_keys
from files.scene_files import write_blender, write_nerfstudio
from keyss.cli import command_table
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
    iterations=10,
    steps=(10, 20),
    seconds=1.0,
    width=100,
    seed=0,
    against_plain=(RenderFidelity(32.0, 8.0), RenderFidelity(31.0, 9.0)),
    details={"capacity": 1000, "bits_per_gaussian": [568, 600]},
)
SMALL = ("--preset", "quick", "--iterations", "20", "--max-gaussians", "100", "--device", "cpu")
COMMANDS = list(command_table.MODULES)
PROGRAM = [sys.executable, "-c", cheap_keys.PROGRAM]


class Said(NamedTuple):
    """What a run of the command line came to."""

    status: int
    out: str
    err: str


Run = Callable[..., Said]  # of the fixture `keyss`


def write_key(path: Path, key: str = "q7Rv2LxT9bWm4KzD") -> Path:
    """A file that nobody else can read."""
    path.touch(0o600)
    path.write_text(f"{key}\n")
    return path


def write_world(folder: Path) -> Path:
    """Scenes `a` and `b`, and `key.txt`."""
    write_blender(folder / "a", count=3, channels=3)
    write_nerfstudio(folder / "b", count=4)
    write_key(folder / "key.txt")
    return folder


def listing(folder: Path) -> dict[str, int]:
    """Every file and folder below, hidden ones too, with its time of change."""
    return {str(path.relative_to(folder)): path.lstat().st_mtime_ns for path in sorted(folder.rglob("*"))}


def assert_refused(said: Said, status: int, words: str) -> None:
    """The exit status, and one or two lines that hold `words`."""
    assert said.status == status, said.err
    assert words in said.err
    assert said.err.startswith("keyss: ")
    assert 1 <= len(said.err.splitlines()) <= 2
    assert "Traceback" not in said.err
    assert said.out == ""
