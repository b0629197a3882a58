"""Random keys."""

from __future__ import annotations

import math
import secrets
import string

from keyss.core.errors import UsageError

ALPHABET = string.ascii_letters + string.digits


def generate_key(length: int = 16) -> str:
    """A random alphanumeric key of the system's random source: 5.95 bits per character.

    Raises UsageError for a length outside 1 to 1024.
    """
    if not 1 <= length <= 1024:
        raise UsageError(f"a key has 1 to 1024 characters, not {length}")
    return "".join(secrets.choice(ALPHABET) for _ in range(length))


def length_for(bits: int) -> int:
    """Length for which `generate_key` reaches `bits`."""
    return math.ceil(bits / math.log2(len(ALPHABET)))
