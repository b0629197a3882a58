"""Seeds keyss's random numbers per test on CI, independently of the order and number of processes.

Elsewhere they stay random. Other packages and child processes keep their own randomness.
"""

from __future__ import annotations

import os
import random
import secrets
import sys
from collections.abc import Iterator

import pytest

_sources: list[random.Random] = []  # of the test and of the fixtures being set up, innermost last
_urandom, _randbelow = os.urandom, secrets.randbelow


def patch_random_sources() -> None:
    """Replace the sources that keyss draws from."""
    os.urandom, secrets.randbelow = _bytes, _number


def seed_test(item: pytest.Item) -> None:
    """Seed with the name of the test."""
    _sources[:] = [random.Random(item.nodeid)]


@pytest.hookimpl(wrapper=True)
def pytest_fixture_setup(
    fixturedef: pytest.FixtureDef[object], request: pytest.FixtureRequest
) -> Iterator[None]:
    """Seed shared fixtures with their own names."""
    parameter = getattr(request, "param_index", 0)
    _sources.append(random.Random(f"{fixturedef.baseid}::{fixturedef.argname}[{parameter}]"))
    try:
        return (yield)
    finally:
        _sources.pop()


def _bytes(size: int, /) -> bytes:
    return _sources[-1].randbytes(size) if _is_ours() else _urandom(size)


def _number(exclusive_upper_bound: int) -> int:
    return _sources[-1].randrange(exclusive_upper_bound) if _is_ours() else _randbelow(exclusive_upper_bound)


def _is_ours() -> bool:
    caller = sys._getframe(2).f_globals.get("__name__", "")
    return bool(_sources) and caller.split(".")[0] == "keyss"
