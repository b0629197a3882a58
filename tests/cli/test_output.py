"""Closed, full and broken output streams; encodings other than UTF-8."""

from __future__ import annotations

import io
import json
import os
import shutil
import subprocess
from pathlib import Path

import pytest

from cli.harness import COMMANDS, PROGRAM, SMALL, Run
from keyss.cli import main, process

NARROW = ["ascii", "cp1252", *(pytest.param(name, marks=pytest.mark.slow) for name in ("latin-1", "cp437"))]


def shell(redirection: str, *arguments: object, **environment: str) -> subprocess.CompletedProcess[bytes]:
    """`keyss ARGUMENTS REDIRECTION`, as a shell runs it."""
    command = ["sh", "-c", f'"$@" {redirection}', "sh", *PROGRAM, *map(str, arguments)]
    variables = {**os.environ, "COLUMNS": "100", **environment}
    return subprocess.run(command, capture_output=True, env=variables, timeout=120, check=False)


@pytest.mark.parametrize(
    ("redirection", "status"),
    [
        (">&-", 0),
        ("2>&-", 0),
        ("2>/dev/full", 0),
        ("<&- >&- 2>&-", 0),
        (">/dev/full", 5),
        ("", 141),
    ],
)
def test_broken_output_streams(tmp_path: Path, redirection: str, status: int) -> None:
    key = tmp_path / "key.txt"
    arguments: list[object] = ["keygen", "-o", key]
    done = shell(redirection, *arguments) if redirection else _run_with_closed_pipe(arguments)
    assert done.returncode == status, done.stderr
    assert b"Traceback" not in done.stderr
    assert b"internal error" not in done.stderr
    assert len(key.read_bytes()) == 17
    assert [path.name for path in tmp_path.iterdir()] == ["key.txt"]


def _run_with_closed_pipe(arguments: list[object]) -> subprocess.CompletedProcess[bytes]:
    pipe = subprocess.PIPE
    process = subprocess.Popen([*PROGRAM, *map(str, arguments)], stdout=pipe, stderr=pipe)
    assert process.stdout is not None
    process.stdout.close()
    _, err = process.communicate(timeout=120)
    assert err == b""
    return subprocess.CompletedProcess([], process.returncode, b"", err)


@pytest.mark.parametrize("command", ["keygen", "--help", "--version"])
def test_closed_pipe(command: str) -> None:
    assert _run_with_closed_pipe([command]).returncode == 141


@pytest.mark.parametrize(("redirection", "status"), [("2>/dev/full", 4), ("2>&-", 4), ("2>&- >&-", 4)])
def test_exit_status_with_broken_stderr(redirection: str, status: int) -> None:
    assert shell(redirection, "info", "nowhere").returncode == status


@pytest.mark.parametrize("encoding", NARROW)
def test_help_and_errors_in_any_encoding(encoding: str) -> None:
    done = shell("", "--help", PYTHONIOENCODING=encoding)
    assert (done.returncode, done.stderr) == (0, b"")
    result = done.stdout.decode(encoding)
    assert all(f" {name} " in result for name in COMMANDS)
    assert "?" not in result
    done = shell("", "info", "nowhere/ä鍵", PYTHONIOENCODING=encoding)
    assert done.returncode == 4
    assert done.stderr.decode(encoding).startswith("keyss: error: nowhere/")


@pytest.mark.slow
def test_c_locale(workspace: Path, tmp_path: Path) -> None:
    """`fit` and `info` in the C locale without Python's UTF-8 mode."""
    plain = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    done = shell("", "fit", workspace / "b", "-o", tmp_path / "ä鍵", *SMALL[2:], **plain)
    assert done.returncode == 0, done.stderr
    assert b"fit b: 20 steps\n" in done.stderr
    assert os.fsencode(tmp_path / "ä鍵" / "model.ply") in done.stdout  # paths are printed unchanged
    done = shell("", "info", tmp_path / "ä鍵", "--json", **plain)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) != {}


@pytest.mark.parametrize("encoding", ["ascii", "cp437"])
def test_json_in_any_encoding(
    keyss: Run, workspace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, encoding: str
) -> None:
    shutil.copytree(workspace / "b", tmp_path / "ä鍵")
    stream = io.TextIOWrapper(io.BytesIO(), encoding, process.REPLACING)
    monkeypatch.setattr("sys.stdout", stream)
    assert main(["info", str(tmp_path / "ä鍵"), "--json"]) == 0
    assert json.loads(stream.buffer.getvalue().decode(encoding))["name"] == "ä鍵"  # type: ignore[attr-defined]
