"""Ctrl-C and other signals at any moment: one line, status 128 + signal, and no lost work."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from cli.harness import PROGRAM, Result, Run, assert_refused, listing, start_handling

WORDS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated", signal.SIGHUP: "terminated"}


@pytest.mark.parametrize(
    ("command", "seconds", "signum"), [("help", 0.05, signal.SIGINT), ("reveal", 0.9, signal.SIGTERM)]
)
def test_signal_during_command(
    workspace: Path, tmp_path: Path, command: str, seconds: float, signum: signal.Signals
) -> None:
    """It stops, or finishes before the signal arrives."""
    stego = next((workspace / "hidden").rglob("publish/model.ply"))
    reveal = ["reveal", stego, "--key-file", workspace / "key.txt", "-o", tmp_path / "secret.ply"]
    process = start_handling(["--help"] if command == "help" else reveal)
    time.sleep(seconds)
    process.send_signal(signum)
    _, err = process.communicate(timeout=120)
    assert process.returncode in (0, 128 + signum), err
    if process.returncode:
        (line,) = [line for line in err.splitlines() if line.startswith("keyss: ")]
        assert line.startswith(f"keyss: {WORDS[signum]}"), err
    assert "Traceback" not in err
    assert "ignored" not in err
    assert not [name for name in listing(tmp_path) if name.endswith(".unfinished")]


def _run(program: str, *arguments: str) -> Result:
    command = [sys.executable, "-c", program, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    return Result(done.returncode, done.stdout, done.stderr)


LOADING = """
import os, signal, sys, types
class Loading:
    def find_spec(self, name, path=None, target=None):
        if name == {module!r}:
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Loading())
from keyss.cli.process import main
main()
"""


_ALSO = ("keyss.cli.entry", "tyro", "torch.nn", "numba.core.types")


@pytest.mark.parametrize(
    "module", ["torch._C", *(pytest.param(name, marks=pytest.mark.slow) for name in _ALSO)]
)
def test_ctrl_c_during_import(workspace: Path, module: str) -> None:
    """An exception would leave torch half imported, and the next import crashes."""
    stego, key = next((workspace / "hidden").rglob("publish/model.ply")), workspace / "key.txt"
    verify = ["verify", str(stego), "--key-file", str(key)]  # imports as much as any command
    status, out, err = _run(LOADING.format(module=module), *verify)
    assert (status, out, err.splitlines()[-1]) == (130, "", "keyss: interrupted")  # progress before it


IN_A_COMMAND = """
import os, signal, sys, time
from keyss.cli import entry
def run(arguments, options):
    {body}
entry._run = run
from keyss.cli.process import main
main()
"""


@pytest.mark.parametrize(
    ("body", "printed"),
    [
        # Cleanup runs; a second signal does not wait for it.
        ("try: time.sleep(60)\n    finally: print('cleaned', flush=True)", "cleaned\n"),
        ("try: time.sleep(60)\n    finally: os.kill(os.getpid(), signal.SIGTERM); time.sleep(60)", ""),
        # An interrupt that was replaced or swallowed still counts.
        ("try: time.sleep(60)\n    except BaseException: raise ValueError('boom')", ""),
        ("try: time.sleep(60)\n    except BaseException: pass", ""),
        ("class Dropping:\n        def __del__(self): time.sleep(60)\n    Dropping(); time.sleep(60)", ""),
    ],
)
def test_ctrl_c_during_work(body: str, printed: str) -> None:
    alarm = "signal.signal(signal.SIGALRM, lambda *_: os.kill(os.getpid(), signal.SIGINT)); signal.alarm(1)"
    program = IN_A_COMMAND.format(body=f"{alarm}\n    {body}")
    assert _run(program) == Result(130, printed, "keyss: interrupted\n")


@pytest.mark.parametrize("signum", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_signal_during_training(keyss: Run, workspace: Path, tmp_path: Path, signum: signal.Signals) -> None:
    small = ("--max-gaussians", 100, "--device", "cpu")

    def arguments(out: Path) -> list[object]:
        return ["fit", workspace / "b", "-o", out, "--iterations", 400, "--seed", 0, *small]

    whole, parts = tmp_path / "whole", tmp_path / "parts"
    command = [*PROGRAM, *map(str, arguments(parts))]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        line = process.stderr.readline()
        while line and not line.startswith("fit b: 400 steps"):
            line = process.stderr.readline()
        process.send_signal(signum)
        out, err = process.communicate(timeout=60)
    assert process.returncode == 128 + signum, err
    assert out == ""
    assert "Traceback" not in err
    assert err.splitlines()[-1].startswith(f"keyss: {WORDS[signum]} at iteration ")
    assert err.splitlines()[-1].endswith("continue with the same command and --resume")
    assert not list(parts.rglob("model.ply"))

    assert_refused(keyss(*arguments(parts)), 5, "--resume")
    result = keyss(*arguments(parts), "--resume")
    assert result.status == 0, result.err
    assert "continuing at" in result.err
    assert keyss(*arguments(whole)).status == 0
    assert (parts / "model.ply").read_bytes() == (whole / "model.ply").read_bytes()
    assert set(listing(parts)) == set(listing(whole))
