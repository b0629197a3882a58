"""Tests marked `alone` measure time: while one of them runs, no other process of the tests does anything.

pytest-xdist knows no such thing: its groups run in one process, beside which the others go on.
"""

from __future__ import annotations

import fcntl
from collections.abc import Generator
from pathlib import Path

import pytest

GATE, ROOM = Path(__file__), Path(__file__).with_name("conftest.py")  # files to lock, whatever is in them


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    alone = item.get_closest_marker("alone") is not None
    with ROOM.open("rb") as room:  # leaves it when it is closed
        with GATE.open("rb") as gate:  # one waits at a time, so that those who share do not keep one out
            fcntl.flock(gate, fcntl.LOCK_EX)
            fcntl.flock(room, fcntl.LOCK_EX if alone else fcntl.LOCK_SH)
        return (yield)
