"""Folders that are made once for all processes of the tests, and that no test may change."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Callable
from pathlib import Path

import pytest


def make_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], None]) -> Path:
    """The folder, which `make` fills; who comes while another process makes it waits for it.

    What was left half made by an error is not taken: the next one makes another.
    """
    base = factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        base = base.parent  # above the folders of its workers
    with (base / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        number = len(list(base.glob(f"{name}-[0-9]*")))
        last = base / f"{name}-{number - 1}"
        if (base / f"{name}.done").exists():
            return last
        folder = base / f"{name}-{number}"
        folder.mkdir()
        make(folder)
        (base / f"{name}.done").touch()
        return folder
