"""Argon2id at almost no cost, for all tests but those marked `argon2`.

At its cost a key takes 0.1 s of two cores, sixteen times as long in low bits, and most of the time of the
tests would be spent there. What a key becomes is as sensitive to all that goes in, costs included, so that
nothing opens here what would not open what it does at full cost; what is expected of the real costs (vectors,
files of before, other implementations) is marked. A fixture that several tests share is made at the cost of
the first of them: a marked test makes what it opens itself.
"""

from __future__ import annotations

import hashlib
from typing import Any

import argon2.low_level
import pytest

_argon2id = argon2.low_level.hash_secret_raw
_cheap = True


def hash_secret_raw(
    secret: bytes, salt: bytes, *, time_cost: int, memory_cost: int, parallelism: int, **rest: Any
) -> bytes:
    """Argon2id as it is asked for, or of 8 KiB and a salt that depends on what was asked for."""
    if _cheap:
        salt = hashlib.sha256(salt + repr((time_cost, memory_cost, parallelism)).encode()).digest()
        time_cost, memory_cost, parallelism = 1, 8, 1
    return _argon2id(
        secret, salt, time_cost=time_cost, memory_cost=memory_cost, parallelism=parallelism, **rest
    )


def pytest_sessionstart() -> None:
    from keyss.keys import derivation

    derivation.hash_secret_raw = hash_secret_raw


def set_key_cost(item: pytest.Item) -> None:
    """For the test and its fixtures from now on."""
    global _cheap
    _cheap = item.get_closest_marker("argon2") is None


# A process of `keyss` in which keys are as cheap as they are in tests: `python -c PROGRAM ARGUMENTS`.
PROGRAM = f"""
import sys
sys.path.append({str(__file__).rpartition("/")[0]!r})
import argon2.low_level, cheap_keys
argon2.low_level.hash_secret_raw = cheap_keys.hash_secret_raw
from keyss.cli.process import main
main()
"""
