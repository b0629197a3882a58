"""Authenticated encryption of one payload: compressed if that helps, and padded, under a data key of its own.

ChaCha20-Poly1305 (RFC 8439) with a zero nonce. This is safe because each data key encrypts one message only:
it is random, or derived from everything that it encrypts.
"""

from __future__ import annotations

import struct
import zlib

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305

from keyss.core.errors import InputError, UsageError
from keyss.keys.derivation import expand

MAX_PAYLOAD_BYTES = 256 << 20  # before compression
# A payload of more than MAX_RATIO n + SMALL_PAYLOAD bytes that compress to n is stored without compression.
MAX_RATIO, SMALL_PAYLOAD = 16, 1 << 20
OVERHEAD = 4 + 16  # length of the data, and the tag
_NONCE = bytes(12)
_COMPRESSED = 1 << 31  # flag in the length
_SAMPLES, _SAMPLE_BYTES = 16, 1 << 12  # samples that show whether compression of a large payload helps
_HELPS = 0.97  # maximum compressed / original size of samples


def compressed_size(payload: bytes) -> int:
    """Bytes of `payload` as `encrypt` compresses it."""
    return len(_compress(payload)[1])


def encrypt(data_key: bytes, payload: bytes, associated: bytes = b"", *, size: int) -> bytes:
    """Encrypt `payload` under a fresh `data_key` (32 bytes), padded to `size` bytes.

    `size`: at least `compressed_size` + OVERHEAD. `associated` is authenticated too, and needed to decrypt.
    Raises UsageError for a payload of more than 256 MiB.
    """
    if len(payload) > MAX_PAYLOAD_BYTES:
        raise UsageError(f"expected at most {MAX_PAYLOAD_BYTES:,} bytes to encrypt, got {len(payload):,}")
    flag, packed = _compress(payload)
    if size < len(packed) + OVERHEAD:
        raise ValueError(f"{len(packed)} bytes do not fit into {size}")
    plain = b"".join([struct.pack("<I", flag | len(packed)), packed, bytes(size - len(packed) - OVERHEAD)])
    return _cipher(data_key).encrypt(_NONCE, plain, associated)


def decrypt(data_key: bytes, encrypted: bytes | memoryview, associated: bytes = b"") -> bytes:
    """Decrypt a payload. Raises InputError if anything differs from the result of `encrypt`."""
    try:
        plain = _cipher(data_key).decrypt(_NONCE, encrypted, associated)
    except (InvalidTag, ValueError) as error:
        raise InputError("the encrypted data are damaged: their authentication fails") from error
    (length,) = struct.unpack_from("<I", plain.ljust(4, b"\0"))
    flag, length = length & _COMPRESSED, length & ~_COMPRESSED
    packed = plain[4 : 4 + length]
    if len(packed) != length:
        raise InputError("the encrypted data are incomplete")
    if not flag:
        return packed
    # Bounded, although only a holder of the key can have written it.
    unpacker = zlib.decompressobj()
    try:
        payload = unpacker.decompress(packed, _max_size(len(packed)))
    except zlib.error as error:
        raise InputError(f"the encrypted data cannot be decompressed: {error}") from error
    if not unpacker.eof or unpacker.unused_data:
        raise InputError(
            f"the encrypted data are incomplete, or decompress to more than {_max_size(len(packed)):,} bytes"
        )
    return payload


def _cipher(data_key: bytes) -> ChaCha20Poly1305:
    return ChaCha20Poly1305(expand(data_key, "payload", 32))


def _compress(payload: bytes) -> tuple[int, bytes]:
    """_COMPRESSED and a zlib stream if that is shorter, else 0 and `payload`."""
    step = max(_SAMPLE_BYTES, -(-len(payload) // _SAMPLES))
    sample = b"".join(payload[at : at + _SAMPLE_BYTES] for at in range(0, len(payload), step))
    if len(zlib.compress(sample, 1)) <= _HELPS * len(sample):
        packed = zlib.compress(payload, 9)
        if len(packed) < len(payload) <= _max_size(len(packed)):
            return _COMPRESSED, packed
    return 0, payload


def _max_size(packed: int) -> int:
    """Limit of the decompressed bytes of `packed` bytes: bounds a reader's memory."""
    return min(MAX_PAYLOAD_BYTES, MAX_RATIO * packed + SMALL_PAYLOAD)
