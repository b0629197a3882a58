"""Handed-over files: each reveals a secret together with the published model.

Methods that do not store all of a secret in the published model have one per secret. It is encrypted with the
secret's key if the method has keys; else whoever has the file sees the secret.

    magic (16 bytes) | method (15) | 1 if encrypted, else 0 | salt (16, zeros if not encrypted) | content
"""

from __future__ import annotations

import os

from keyss.channels import METHOD_BYTES, Payload, pack_method, unpack_method
from keyss.core.errors import InputError, UsageError, WrongKeyError
from keyss.keys import DerivedKey
from keyss.keys.derivation import SALT_BYTES
from keyss.keys.encryption import DATA_KEY_BYTES, decrypt, encrypt

SUFFIX = ".keyss"
MAX_BYTES = 1 << 30
_MAGIC = b"keyss handed 1\0\0"
_HEADER = len(_MAGIC) + METHOD_BYTES + 1 + SALT_BYTES
_EXPECTED = "expected a file that was handed over, as `keyss hide` writes them for some methods"


def pack(payload: Payload, key: str | None) -> bytes:
    """The bytes of the file, encrypted if there is a key."""
    start = _MAGIC + pack_method(payload.method)
    if key is None:
        return start + bytes(1 + SALT_BYTES) + payload.data
    header = start + b"\1" + os.urandom(SALT_BYTES)
    return header + encrypt(_data_key(header, key), payload.data, header)


def is_encrypted(data: bytes) -> bool:
    """True if the file needs a key. Raises InputError for other files."""
    if len(data) < _HEADER or not data.startswith(_MAGIC):
        raise InputError(f"{_EXPECTED}, got something else")
    encrypted = data[len(_MAGIC) + METHOD_BYTES]
    if encrypted not in (0, 1):
        raise InputError(f"{_EXPECTED}, got a damaged one")
    return bool(encrypted)


def unpack(data: bytes, key: str | None) -> Payload:
    """The payload of `pack`. Raises InputError, WrongKeyError, UsageError for a missing or unneeded key."""
    encrypted, header, content = is_encrypted(data), data[:_HEADER], data[_HEADER:]
    try:
        method = unpack_method(header[len(_MAGIC) :])
    except UnicodeDecodeError as error:
        raise InputError(f"{_EXPECTED}, got a damaged one") from error
    if not encrypted:
        if key is not None:
            raise UsageError(f"the method {method} has no keys: whoever has this file sees the secret")
        return Payload(method, content)
    if key is None:
        raise UsageError("this file is encrypted with a key: give it")
    try:
        return Payload(method, decrypt(_data_key(header, key), content, header))
    except InputError as error:
        raise WrongKeyError("this key opens nothing here, or the file is damaged") from error


def _data_key(header: bytes, key: str) -> bytes:
    return DerivedKey.of(key, header[-SALT_BYTES:]).expand("handed", DATA_KEY_BYTES)
