"""Read-only folders shared by all test processes."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Callable
from pathlib import Path

import pytest


def make_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], None]) -> Path:
    """Fill a folder with `make` in the first process; the others wait for it.

    A folder left by a failed `make` is not reused.
    """
    base = factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        base = base.parent  # shared by the workers
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
