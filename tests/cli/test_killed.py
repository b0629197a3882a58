"""Commands killed at any moment after their start and repeated give the result of an uninterrupted run."""

from __future__ import annotations

import hashlib
import json
import random
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest

from cli.harness import start_handling, write_workspace

SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
SIZE = "--preset quick --iterations 150 --max-gaussians 240 --device cpu --seed 0"
UNFINISHED = ("unfinished", "lock", "checkpoint")  # parts of the names of files that must not remain


@dataclass(frozen=True)
class Command:
    """A command; OUT and RUN in its arguments stand for its output and its run folder."""

    arguments: str
    again: str  # the option to repeat it with, if any
    in_run: bool = False  # needs a copy of the run that `hide` writes
    results: tuple[str, ...] = ()  # files compared byte by byte
    numbers: tuple[str, ...] = ()  # JSON compared without times


SCENES = "--cover a --secret b --key-file key.txt"
COMMANDS: Mapping[str, Command] = {
    "fit": Command(f"fit a -o OUT {SIZE}", "--resume", results=("model.ply", "private/config.json")),
    "hide": Command(
        f"hide {SCENES} --publish converted --min-psnr=0 -o OUT {SIZE}",
        "--resume",
        results=("publish/model.ply", "private/cover.ply", "private/secret-1.ply"),
        numbers=("private/metrics.json",),
    ),
    "audit": Command(
        "audit RUN --key-file key.txt --controls 2 --only parameters --device cpu",
        "",
        in_run=True,
        numbers=("private/audit/audit.json",),
    ),
    "reveal": Command(
        "reveal RUN/publish/model.ply --key-file key.txt -o OUT --device cpu",
        "--overwrite",
        in_run=True,
        results=("",),
    ),
}


def without_times(text: str) -> object:
    """Parsed JSON without durations and paths."""

    def plain(value: object) -> object:
        if isinstance(value, dict):
            return {name: plain(each) for name, each in value.items() if name not in ("seconds", "path")}
        return [plain(each) for each in value] if isinstance(value, list) else value

    return plain(json.loads(text))


def result_of(command: Command, out: Path, run: Path) -> list[object]:
    base = run if command.in_run and command.numbers else out
    files: list[object] = [
        hashlib.sha256((base / name if name else base).read_bytes()).hexdigest() for name in command.results
    ]
    return files + [without_times((base / name).read_text()) for name in command.numbers]


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_workspace(tmp_path_factory.mktemp("killed"))


@pytest.fixture(scope="module")
def reference(workspace: Path) -> Callable[[str], tuple[list[object], float]]:
    """Results and durations of uninterrupted commands."""

    @cache
    def run(name: str) -> tuple[list[object], float]:
        if COMMANDS[name].in_run:
            run("hide")
        out, run_folder, arguments = prepare(workspace, name, "reference")
        before = time.monotonic()
        with start_handling(arguments, workspace) as process:
            _, err = process.communicate()
        assert process.returncode == 0, err
        return result_of(COMMANDS[name], out, run_folder), time.monotonic() - before

    return run


def prepare(folder: Path, name: str, which: str) -> tuple[Path, Path, list[str]]:
    """Output, run folder and arguments of a command in its own folder."""
    place = folder / f"{name}-{which}"
    place.mkdir()
    out, run = place / ("out.ply" if name == "reveal" else "out"), place / "run"
    if COMMANDS[name].in_run:
        shutil.copytree(folder / "hide-reference" / "out", run)
    parts = [
        part.replace("OUT", str(out)).replace("RUN", str(run)) for part in COMMANDS[name].arguments.split()
    ]
    return out, run, parts


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(50))
def test_killed_commands_resume(
    workspace: Path, reference: Callable[[str], tuple[list[object], float]], seed: int
) -> None:
    name = list(COMMANDS)[seed % len(COMMANDS)]
    signum = SIGNALS[seed // len(COMMANDS) % len(SIGNALS)]
    expected, seconds = reference(name)
    rng = random.Random(seed)
    out, run, arguments = prepare(workspace, name, str(seed))
    mine = out.parent / "mine.txt"
    mine.write_text("mine")
    again = arguments
    for _ in range(rng.choice((1, 1, 2))):  # some are killed twice
        with start_handling(again, workspace) as process:
            try:
                process.wait(rng.uniform(0, 1.1 * seconds))
            except subprocess.TimeoutExpired:
                process.send_signal(signum)
            _, err = process.communicate(timeout=600)
        assert "Traceback" not in err, err
        finished = process.returncode == 0 or " a finished " in err  # just before the signal
        assert finished or process.returncode in (-signum, 128 + signum), err
        again = [*arguments, *COMMANDS[name].again.split()]
        if finished:
            break
    if process.returncode != 0:
        with start_handling(again, workspace) as process:
            _, err = process.communicate(timeout=600)
        assert process.returncode == 0 or " a finished " in err, err
        assert "Traceback" not in err
    assert result_of(COMMANDS[name], out, run) == expected
    assert mine.read_text() == "mine"
    left = [path.name for path in out.parent.rglob("*") if any(word in path.name for word in UNFINISHED)]
    assert left == []
    shutil.rmtree(out.parent)
