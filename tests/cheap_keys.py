"""Cheap Argon2id for all tests except those marked `argon2`.

At full cost a key takes 0.1 s on two cores, and one attempt on low bits takes 16 keys. The cheap hash still
depends on the key, the salt and the requested costs. Tests that need the real hash (vectors, frozen files,
other implementations) are marked. Shared fixtures use the cost of the first test that requests them, so a
marked test creates its own inputs.
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
    """Argon2id, or a hash of 8 KiB whose salt depends on the requested costs."""
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
    """Set the cost for a test and its fixtures."""
    from keyss.keys import derivation

    global _cheap
    derivation._argon2id.cache_clear()
    _cheap = item.get_closest_marker("argon2") is None


# `python -c PROGRAM ARGUMENTS` runs keyss with cheap keys.
PROGRAM = f"""
import sys
sys.path.append({str(__file__).rpartition("/")[0]!r})
import argon2.low_level, cheap_keys
argon2.low_level.hash_secret_raw = cheap_keys.hash_secret_raw
from keyss.cli.process import main
main()
"""
