"""Companion files: with one, the published model shows a secret without a key.

Methods that do not store a whole secret in the published model write one per secret.

    magic (16 bytes) | payload
"""

from __future__ import annotations

from keyss.channels import Payload, pack_payload, unpack_payload
from keyss.core.errors import InputError

SUFFIX = ".keyss"
MAX_BYTES = 1 << 30
_MAGIC = b"keyss handed 3\0\0"
_EXPECTED = "expected a `.keyss` file, as `keyss hide` writes for some methods"


def pack(payload: Payload) -> bytes:
    """The bytes of a file."""
    return _MAGIC + pack_payload(payload)


def unpack(data: bytes) -> Payload:
    """Invert `pack`. Raises InputError."""
    if not data.startswith(_MAGIC):
        raise InputError(f"{_EXPECTED}, got something else")
    return unpack_payload(data[len(_MAGIC) :])
