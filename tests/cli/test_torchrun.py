"""Commands in several processes, as torchrun starts them."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import pytest

from cli.said import PROGRAM, SMALL, Run, assert_refused

pytestmark = pytest.mark.counted


def environment(rank: int, port: int) -> Mapping[str, str]:
    """What torchrun tells one of two processes."""
    told = {"RANK": rank, "LOCAL_RANK": rank, "WORLD_SIZE": 2, "MASTER_PORT": port, "OMP_NUM_THREADS": 1}
    return {**os.environ, **{name: str(value) for name, value in told.items()}, "MASTER_ADDR": "127.0.0.1"}


@contextmanager
def two(*arguments: object) -> Iterator[list[subprocess.Popen[str]]]:
    """The same command in two processes, which end with the block."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    pipe = subprocess.PIPE
    processes = [
        subprocess.Popen(
            [*PROGRAM, *map(str, arguments)], env=environment(rank, port), stdout=pipe, stderr=pipe, text=True
        )
        for rank in range(2)
    ]
    try:
        yield processes
    finally:
        for each in processes:
            each.kill()
            each.communicate()


def test_where_one_process_is_killed_the_first_saves_and_one_process_goes_on(
    keyss: Run, world: Path, tmp_path: Path
) -> None:
    out = tmp_path / "fit"
    command = ("fit", world / "a", "-o", out, *SMALL, "--iterations", 900)
    with two("-v", *command) as (first, second):
        assert first.stderr is not None
        while "/900" not in (line := first.stderr.readline()):  # the training goes on
            assert line
        second.send_signal(signal.SIGKILL)
        said, told = first.communicate(timeout=60)
        assert second.wait() == -signal.SIGKILL
    assert first.returncode == 6
    assert said == ""
    assert "stopped at" in told.splitlines()[-2]
    assert told.splitlines()[-1] == (
        "keyss: error: another of the 2 processes that train together has ended; "
        "continue with the same command and --resume"
    )
    assert (out / "private" / "checkpoint" / "fit.safetensors").stat().st_size > 0
    went_on = keyss(*command, "--resume")
    assert went_on.status == 0, went_on.err
    assert "continuing at" in went_on.err
    assert went_on.out.startswith(" PSNR")
    assert '"views_per_step": 2' in (out / "private" / "config.json").read_text()


def test_the_first_process_answers_for_both(world: Path, tmp_path: Path) -> None:
    out = tmp_path / "hidden"
    scenes = ("--cover", world / "a", "--secret", world / "b", "--key-file", world / "key.txt")
    with two("hide", *scenes, "--publish", "any", "--min-psnr", 0, "-o", out, *SMALL) as processes:
        (said, told), (nothing, quiet) = (each.communicate(timeout=120) for each in processes)
    assert [each.returncode for each in processes] == [0, 0], told + quiet
    assert (out / "publish").is_dir()
    assert "publish this" in said
    assert "plain model of the secret" in told
    assert (nothing, quiet) == ("", "")


@pytest.fixture
def second_of_two(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in environment(1, 1).items():
        monkeypatch.setenv(name, value)


@pytest.mark.usefixtures("second_of_two")
def test_other_processes_say_only_what_the_first_cannot_know(keyss: Run, tmp_path: Path) -> None:
    said = keyss("fit", tmp_path / "none", "-o", tmp_path / "out", "--preset", "nonsense")
    assert (said.status, said.out, said.err) == (2, "", "")
    (tmp_path / "a.csv").touch()
    said = keyss("hide", "--batch", tmp_path / "a.csv", "-o", tmp_path / "out")
    assert (said.status, said.out, said.err) == (2, "", "")


def test_commands_that_do_not_train_are_refused(
    keyss: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in environment(0, 1).items():
        monkeypatch.setenv(name, value)
    assert_refused(keyss("info", tmp_path / "model.ply"), 2, "start `keyss info` without it")
    (tmp_path / "a.ply").touch()
    for given in (("--batch", tmp_path), ("--secret-file", tmp_path, "--cover", tmp_path / "a.ply")):
        assert_refused(keyss("hide", *given, "-o", tmp_path), 2, "torchrun is for")
    scenes = ("--cover", tmp_path, "--secret", tmp_path, "-o", tmp_path / "out")
    assert_refused(keyss("hide", *scenes), 2, "no key")
