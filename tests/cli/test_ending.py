"""Readers that leave, and Ctrl-C."""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Callable
from pathlib import Path

from cli.said import PROGRAM, Said, assert_refused


def test_a_reader_that_leaves_is_no_error() -> None:
    process = subprocess.Popen([*PROGRAM, "keygen"], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdout is not None
    process.stdout.close()
    _, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (141, b"")


def test_ctrl_c_saves_and_resume_ends_in_the_same_files(
    keyss: Callable[..., Said], world: Path, tmp_path: Path
) -> None:
    def arguments(out: Path) -> list[object]:
        return ["fit", world / "b", "-o", out, "--iterations", 400, "--max-gaussians", 100, "--device", "cpu"]

    whole, parts = tmp_path / "whole", tmp_path / "parts"
    command = [*PROGRAM, *map(str, arguments(parts))]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        line = process.stderr.readline()
        while line and not line.startswith("fit b: 400 steps"):
            line = process.stderr.readline()
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert out == ""
    assert "Traceback" not in err
    assert err.splitlines()[-1].startswith("keyss: interrupted at iteration ")
    assert err.splitlines()[-1].endswith("continue with the same command and --resume")
    assert [path.name for path in parts.iterdir()] == ["private"]

    assert_refused(keyss(*arguments(parts)), 5, "--resume")
    said = keyss(*arguments(parts), "--resume")
    assert said.status == 0, said.err
    assert "continuing at" in said.err
    assert keyss(*arguments(whole)).status == 0
    assert (parts / "model.ply").read_bytes() == (whole / "model.ply").read_bytes()
    assert sorted(path.name for path in parts.iterdir()) == ["model.ply", "private"]
