"""Commands killed at any moment after their start and repeated give the result of an uninterrupted run."""

from __future__ import annotations

import json
import random
import shutil
import signal
import subprocess
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest

from cli.harness import start_handling, write_workspace

SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
SIZE = "--preset quick --iterations 150 --max-gaussians 240 --device cpu --seed 0"
COMMANDS = {
    "fit": f"fit a {SIZE} -o",
    "hide": f"hide --cover a --secret b --key-file key.txt --publish converted --min-psnr 0 {SIZE} -o",
}
UNFINISHED = ("unfinished", "lock", "checkpoint")  # parts of the names of files that must not remain


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_workspace(tmp_path_factory.mktemp("killed"))


def result_of(out: Path) -> list[object]:
    """Models, and the metrics without times."""
    metrics = json.loads((out / "private" / "metrics.json").read_text())
    return [metrics | {"seconds": 0}, *(path.read_bytes() for path in sorted(out.rglob("*.ply")))]


@pytest.fixture(scope="module")
def reference(workspace: Path) -> Callable[[str], tuple[list[object], float]]:
    """Results and durations of uninterrupted commands."""

    @cache
    def run(name: str) -> tuple[list[object], float]:
        before, out = time.monotonic(), workspace / f"{name}-reference"
        with start_handling([*COMMANDS[name].split(), out], workspace) as process:
            _, err = process.communicate()
        assert process.returncode == 0, err
        return result_of(out), time.monotonic() - before

    return run


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(30))
def test_killed_commands_resume(
    workspace: Path, reference: Callable[[str], tuple[list[object], float]], seed: int
) -> None:
    name = list(COMMANDS)[seed % len(COMMANDS)]
    signum = SIGNALS[seed // len(COMMANDS) % len(SIGNALS)]
    expected, seconds = reference(name)
    rng, out = random.Random(seed), workspace / f"{name}-{seed}"
    command: list[object] = [*COMMANDS[name].split(), out]
    ended = False
    kills = rng.choice((1, 1, 2))  # some are killed twice
    for attempt in range(kills + 1):
        with start_handling([*command, "--resume"] if attempt else command, workspace) as process:
            if attempt < kills:
                try:
                    process.wait(rng.uniform(0, 1.1 * seconds))
                except subprocess.TimeoutExpired:
                    process.send_signal(signum)
            _, err = process.communicate(timeout=600)
        assert "Traceback" not in err, err
        ended = process.returncode == 0 or "holds a finished run" in err  # just before the signal
        assert ended or process.returncode in (-signum, 128 + signum), err
        if ended:
            break
    assert ended
    assert result_of(out) == expected
    assert [path for path in out.rglob("*") if any(word in path.name for word in UNFINISHED)] == []
    shutil.rmtree(out)
