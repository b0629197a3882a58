"""What keyss draws at random is the same in every run of CI, whichever process runs a test, in which order.

So a failure comes with the change that made it. On other machines it is drawn anew each time, as hypothesis
goes on searching there. What others draw (names of files, keys of servers) stays as it is, and so does what
processes of their own draw.
"""

from __future__ import annotations

import os
import random
import secrets
import sys
from collections.abc import Iterator

import pytest

_sources: list[random.Random] = []  # the innermost last: of the test, or of the fixture that is being set up
_urandom, _randbelow = os.urandom, secrets.randbelow


def patch_random_sources() -> None:
    """From now on."""
    os.urandom, secrets.randbelow = _bytes, _number


def seed_test(item: pytest.Item) -> None:
    """Of a test: its name says what they are."""
    _sources[:] = [random.Random(item.nodeid)]


@pytest.hookimpl(wrapper=True)
def pytest_fixture_setup(
    fixturedef: pytest.FixtureDef[object], request: pytest.FixtureRequest
) -> Iterator[None]:
    """A fixture of several tests draws the same, whichever of them comes first."""
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
