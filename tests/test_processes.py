"""Environment of processes that keyss starts, and available memory."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from keyss import _processes

MEMINFO = Path("/proc/meminfo")


def test_a_started_process_finds_keyss_and_no_key(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Files in the working folder with names of modules do not matter."""
    monkeypatch.setenv("KEYSS_KEY", "a key that nobody is to see")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "elsewhere"))
    (tmp_path / "signal.py").write_text("raise SystemExit(9)")
    (tmp_path / "keyss").mkdir()
    (tmp_path / "keyss" / "__init__.py").write_text("raise SystemExit(9)")
    environment = _processes.environment(3)
    assert (environment["OMP_NUM_THREADS"], environment["NUMBA_NUM_THREADS"]) == ("3", "3")
    assert "KEYSS_KEY" not in environment
    code = "from keyss import _processes; print(_processes.can_start())"
    program = [*_processes.command("keyss")[:-2], "-c", code]
    said = subprocess.run(program, env=environment, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert said.stdout == "False\n"
    assert _processes.can_start()


def test_folders_of_packages_do_not_come_before_the_standard_library(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("PYTHONPATH", raising=False)
    monkeypatch.setattr(_processes, "_package_folders", lambda: [str(tmp_path / "link")])
    (tmp_path / "packages").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "packages")
    monkeypatch.setattr(_processes, "_ROOT", str(tmp_path / "packages"))
    assert "PYTHONPATH" not in _processes.environment(1)
    monkeypatch.setattr(_processes, "_ROOT", str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", "/a")
    assert _processes.environment(1)["PYTHONPATH"] == f"{tmp_path}{os.pathsep}/a"
    monkeypatch.setenv("PYTHONPATH", f"/a{os.pathsep}{tmp_path}")
    assert _processes.environment(1)["PYTHONPATH"] == f"/a{os.pathsep}{tmp_path}"


@pytest.mark.parametrize("name", ["/usr/bin/uwsgi", "", None])
def test_programs_other_than_python_start_no_processes(
    monkeypatch: pytest.MonkeyPatch, name: str | None
) -> None:
    monkeypatch.setattr(sys, "executable", name)
    assert not _processes.can_start()


def test_a_frozen_app_starts_no_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "frozen", True, raising=False)
    assert not _processes.can_start()


@pytest.mark.skipif(not MEMINFO.exists(), reason="this system has no /proc/meminfo")
def test_available_memory_respects_control_groups(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The minimum over the group and its parents; cached files count as available."""
    inside = Path("/proc/self/cgroup").read_text().split("::", 1)[-1].strip().lstrip("/")
    monkeypatch.setattr(_processes, "_CGROUPS", tmp_path)
    whole = _processes.available_memory()
    assert whole is not None
    assert whole > 10**8
    group = tmp_path / inside
    group.mkdir(parents=True, exist_ok=True)
    for folder, limit in ((tmp_path, "5000000"), (group, "3000000")):
        (folder / "memory.max").write_text(f"{limit}\n")
        (folder / "memory.current").write_text("2500000\n")
        (folder / "memory.stat").write_text("anon 1\ninactive_file 400000\nodd\n")
    assert _processes.available_memory() == int((group / "memory.max").read_text()) - 2_500_000 + 400_000
    for folder in (tmp_path, group):
        (folder / "memory.max").write_text("max\n")
    assert abs((_processes.available_memory() or 0) - whole) < 10**9
