"""What all channels do alike: payloads as bytes, randomness for each file, a key for each secret."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence

from keyss.channels.base import Content, Payload, check_method
from keyss.core.errors import InputError, UsageError

NOTICED = (
    "the secrets are too large, or too many, to lie in this cover as each would alone: whoever holds one of "
    "the keys can notice that there are other secrets"
)


def pack_payload(content: Content) -> bytes:
    """The name of the method, a zero, the data. Raises TypeError for records."""
    if not isinstance(content, Payload):
        raise TypeError("expected a payload: this channel carries no records")
    return check_method(content.method) + b"\0" + content.data


def unpack_payload(packed: bytes) -> Payload:
    """The payload of `pack_payload`. Raises InputError for anything else."""
    name, zero, data = packed.partition(b"\0")
    try:
        check_method(name.decode("ascii"))
    except ValueError as error:
        raise InputError("the hidden data are damaged: they begin with no name of a method") from error
    if not zero:
        raise InputError("the hidden data are damaged: they are not whole")
    return Payload(name.decode("ascii"), data)


def randomness(entropy: bytes | None, *parts: bytes) -> bytes:
    """32 bytes that depend on `entropy` and on all hidden data: no two files share what is derived from them.

    `entropy`: at least 32 bytes that nobody else can know; None takes the system's.
    """
    entropy = os.urandom(32) if entropy is None else entropy
    if len(entropy) < 32:
        raise ValueError(f"expected at least 32 bytes of entropy, got {len(entropy)}")
    return hashlib.sha256(b"".join(hashlib.sha256(part).digest() for part in (entropy, *parts))).digest()


def check_keys(verifiers: Sequence[bytes]) -> None:
    """Raise UsageError unless there is a key, and no two are equal."""
    if not verifiers or len(set(verifiers)) < len(verifiers):
        raise UsageError("two secrets have the same key: expected at least one secret, each with its own")
