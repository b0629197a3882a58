"""Payloads as they are embedded: a length, padding, and authenticated encryption."""

from __future__ import annotations

import struct

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305

from keyss.keys.derivation import expand

OVERHEAD = 4 + 16  # length and tag
_NONCE = bytes(12)  # a data key encrypts one payload


def encrypt_payload(data_key: bytes, payload: bytes, size: int) -> bytes:
    """`payload` in `size` bytes."""
    if len(payload) + OVERHEAD > size:
        raise ValueError(f"{len(payload)} bytes do not fit into {size}")
    plain = struct.pack("<I", len(payload)) + payload
    return _cipher(data_key).encrypt(_NONCE, plain.ljust(size - 16, b"\0"), None)


def decrypt_payload(data_key: bytes, encrypted: bytes) -> bytes | None:
    """The payload; None when anything at all is not as it was (but for a chance of 2^-86 at most)."""
    try:
        plain = _cipher(data_key).decrypt(_NONCE, encrypted, None)
    except InvalidTag:
        return None
    (length,) = struct.unpack_from("<I", plain)
    return plain[4 : 4 + length] if length <= len(plain) - 4 else None


def _cipher(data_key: bytes) -> ChaCha20Poly1305:
    return ChaCha20Poly1305(expand(data_key, "robust/payload", 32))
