"""What every channel does before it writes: randomness for each file, a key for each secret."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence

from keyss.core.errors import UsageError

NOTICED = (
    "the secrets are too large, or too many, to lie in this cover as each would alone: whoever holds one of "
    "the keys can notice that there are other secrets"
)


def randomness(entropy: bytes | None, *parts: bytes) -> bytes:
    """32 bytes that depend on `entropy` and on all that is hidden: no two files share what follows from them.

    `entropy`: at least 32 bytes that nobody else can know; None takes the system's.
    """
    entropy = os.urandom(32) if entropy is None else entropy
    if len(entropy) < 32:
        raise ValueError(f"expected at least 32 bytes of entropy, got {len(entropy)}")
    return hashlib.sha256(b"".join(hashlib.sha256(each).digest() for each in (entropy, *parts))).digest()


def check_keys(verifiers: Sequence[bytes]) -> None:
    """Raise UsageError unless there is a key, and no two are equal."""
    if not verifiers or len(set(verifiers)) < len(verifiers):
        raise UsageError("two secrets have the same key: expected at least one secret, each with its own")
