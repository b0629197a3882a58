"""Companion files: with one, the published model shows a secret without a key.

Methods that do not store a whole secret in the published model write one per secret.

    magic (16 bytes) | method (15) | content
"""

from __future__ import annotations

from keyss.channels import METHOD_BYTES, Payload, pack_method, unpack_method
from keyss.core.errors import InputError

SUFFIX = ".keyss"
MAX_BYTES = 1 << 30
_MAGIC = b"keyss handed 2\0\0"
_HEADER = len(_MAGIC) + METHOD_BYTES
_EXPECTED = "expected a `.keyss` file, as `keyss hide` writes for some methods"


def pack(payload: Payload) -> bytes:
    """The bytes of a file."""
    return _MAGIC + pack_method(payload.method) + payload.data


def unpack(data: bytes) -> Payload:
    """Invert `pack`. Raises InputError."""
    if len(data) < _HEADER or not data.startswith(_MAGIC):
        raise InputError(f"{_EXPECTED}, got something else")
    try:
        return Payload(unpack_method(data[len(_MAGIC) : _HEADER]), data[_HEADER:])
    except UnicodeDecodeError as error:
        raise InputError(f"{_EXPECTED}, got a damaged one") from error
