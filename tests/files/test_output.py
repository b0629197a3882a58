"""Writes are atomic and private, and leave no temporary files."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from keyss.core import OutputError
from keyss.files import atomic_write, lock, write_bytes

WRITE_AND_WAIT = """
import sys, time
from keyss.files import atomic_write
with atomic_write(sys.argv[1]) as file:
    file.write(b"a part")
    file.flush()
    print("writing", flush=True)
    time.sleep(60)
"""
LOCK_AND_WAIT = """
import sys, time
from pathlib import Path
from keyss.files import lock
with lock(Path(sys.argv[1]), Path("runs/first")):
    print("locked", flush=True)
    time.sleep(60)
"""


@contextmanager
def child(program: str, path: Path) -> Iterator[subprocess.Popen[str]]:
    """A process that has printed its first line; it is killed at the end."""
    with subprocess.Popen(
        [sys.executable, "-c", program, str(path)], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline()
        yield process
        process.kill()


def test_files_are_private(tmp_path: Path, umask: None) -> None:
    os.umask(0)
    write_bytes(tmp_path / "x", b"1")
    assert (tmp_path / "x").stat().st_mode & 0o777 == 0o600


def test_leftovers_are_removed(tmp_path: Path) -> None:
    with child(WRITE_AND_WAIT, tmp_path / "x"):
        pass
    assert sorted(path.name for path in tmp_path.iterdir()) == [".x.lock", ".x.unfinished"]
    write_bytes(tmp_path / "x", b"whole")
    assert [path.name for path in tmp_path.iterdir()] == ["x"]
    assert (tmp_path / "x").read_bytes() == b"whole"


def test_concurrent_writes_are_refused(tmp_path: Path) -> None:
    with (
        child(WRITE_AND_WAIT, tmp_path / "x"),
        pytest.raises(OutputError, match="another process is writing it"),
    ):
        write_bytes(tmp_path / "x", b"1")


def test_temporary_links_are_not_followed(tmp_path: Path) -> None:
    victim, temporary = tmp_path / "victim", tmp_path / ".x.unfinished"
    victim.write_bytes(b"mine")
    for link in (temporary.symlink_to, temporary.hardlink_to):
        link(victim)
        write_bytes(tmp_path / "x", b"1")
    assert victim.read_bytes() == b"mine"
    assert not (tmp_path / "x").is_symlink()


@pytest.mark.parametrize("error", [OSError(28, "No space left"), KeyboardInterrupt()])
def test_errors_leave_the_old_file(tmp_path: Path, error: BaseException) -> None:
    def fail() -> None:
        with atomic_write(tmp_path / "x") as file:
            file.write(b"a part")
            raise error

    write_bytes(tmp_path / "x", b"old")
    with pytest.raises(OutputError if isinstance(error, OSError) else type(error)):
        fail()
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"old"]


def test_locks_end_with_their_process(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    with (
        child(LOCK_AND_WAIT, path),
        pytest.raises(OutputError, match="cannot write here: another process"),
        lock(path, Path("here")),
    ):
        pass
    with lock(path, Path("here")):
        assert path.exists()
    assert not path.exists()
