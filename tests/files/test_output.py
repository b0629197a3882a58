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
from keyss.files import atomic_write, check_output_file, held_by, lock, write_bytes

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
with lock(Path(sys.argv[1])):
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


def test_only_the_owner_may_read_what_is_written(tmp_path: Path, umask: None) -> None:
    os.umask(0)
    write_bytes(tmp_path / "x", b"1")
    assert (tmp_path / "x").stat().st_mode & 0o777 == 0o600


def test_what_a_killed_process_left_goes_with_the_next_write(tmp_path: Path) -> None:
    with child(WRITE_AND_WAIT, tmp_path / "x"):
        pass
    assert len(list(tmp_path.iterdir())) == 1  # its temporary file
    write_bytes(tmp_path / "x", b"whole")
    assert [path.name for path in tmp_path.iterdir()] == ["x"]
    assert (tmp_path / "x").read_bytes() == b"whole"


def test_two_processes_do_not_write_one_file(tmp_path: Path) -> None:
    with (
        child(WRITE_AND_WAIT, tmp_path / "x"),
        pytest.raises(OutputError, match="another process is writing it"),
    ):
        write_bytes(tmp_path / "x", b"1")


def test_a_link_in_the_way_of_the_temporary_file_is_not_followed(tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    victim.write_bytes(b"mine")
    (tmp_path / ".x.unfinished").symlink_to(victim)
    with pytest.raises(OutputError):
        write_bytes(tmp_path / "x", b"1")
    (tmp_path / ".x.unfinished").unlink()
    os.link(victim, tmp_path / ".x.unfinished")
    with pytest.raises(OutputError):
        write_bytes(tmp_path / "x", b"1")
    assert victim.read_bytes() == b"mine"


@pytest.mark.parametrize("error", [OSError(28, "No space left"), KeyboardInterrupt()])
def test_an_error_leaves_the_old_file(tmp_path: Path, error: BaseException) -> None:
    def fail() -> None:
        with atomic_write(tmp_path / "x") as file:
            file.write(b"a part")
            raise error

    write_bytes(tmp_path / "x", b"old")
    with pytest.raises(OutputError if isinstance(error, OSError) else type(error)):
        fail()
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"old"]


def test_a_lock_names_its_process_and_dies_with_it(tmp_path: Path) -> None:
    path = tmp_path / "private" / "lock"
    path.parent.mkdir()
    with child(LOCK_AND_WAIT, path) as other:
        assert held_by(path) == str(other.pid)
        with pytest.raises(OutputError, match=f"process {other.pid} is at work"), lock(path):
            pass
    assert held_by(path) is None
    with lock(path):
        assert path.read_text() == str(os.getpid())
    assert not path.exists()


def test_a_folder_is_no_file_to_write(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="is a folder"):
        check_output_file(tmp_path, True)
    with pytest.raises(OutputError, match="there is no folder"):
        check_output_file(tmp_path / "no" / "x", False)
    write_bytes(tmp_path / "x", b"")
    with pytest.raises(OutputError, match="exists"):
        check_output_file(tmp_path / "x", False)
    assert check_output_file(tmp_path / "x", True) == tmp_path / "x"
