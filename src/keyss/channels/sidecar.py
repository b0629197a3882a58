"""The sidecar: encrypted payloads in a file of their own, for models whose low bits will not survive.

    magic "KEYSSEAL", version (1 byte), Argon2id: salt (16), passes (1), KiB (4), lanes (1);
    slots (2), bytes of a slot (4); then the slots

A slot is a data key wrapped under the key's master (AES key wrap, RFC 3394, 40 bytes) and, encrypted under it
with everything before the slots as associated data, the name of the method (15 bytes) and its payload. There
are four slots, or eight for five secrets and so on; those not in use hold random bytes, which nobody can tell
from a payload without its key. A reader tries its key on every slot. Numbers are little-endian.
"""

from __future__ import annotations

import secrets as system_random
import struct
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import astuple
from itertools import combinations

from cryptography.hazmat.primitives.keywrap import InvalidUnwrap, aes_key_unwrap, aes_key_wrap

from keyss.channels.base import METHOD_BYTES, Payload, pack_method, unpack_method
from keyss.core.errors import InputError, UsageError, WrongKeyError
from keyss.keys.derivation import SALT_BYTES, DerivedKey, KeyDerivation, expand, stream
from keyss.keys.encryption import (
    DATA_KEY_BYTES,
    MAX_PAYLOAD_BYTES,
    compressed_size,
    decrypt,
    encrypt,
    encrypted_size,
)

MAGIC = b"KEYSSEAL"
VERSION = 1
SLOTS = 4  # or a multiple of it
MAX_SLOTS = 256
_HEADER = struct.Struct("<8sB16sBIBHI")
_WRAPPED = DATA_KEY_BYTES + 8


def encrypt_sidecar(secrets: Sequence[tuple[str, Payload]], *, entropy: bytes | None = None) -> bytes:
    """A sidecar with one (key, payload) per secret.

    `entropy`: at least 32 bytes that nobody else can know, from which all that is random is derived; by
    default the system's. A run that is to be repeatable gives something that depends on what is thrown away,
    such as the digits that rounding removes: a holder of one key must not be able to derive the unused slots,
    for then they would know which are unused. Raises UsageError for no secrets, too many, or equal keys.
    """
    if not 1 <= len(secrets) <= MAX_SLOTS:
        raise UsageError(f"expected 1 to {MAX_SLOTS} secrets, got {len(secrets)}")
    entropy = system_random.token_bytes(32) if entropy is None else entropy
    derivation = KeyDerivation(salt=expand(entropy, "sidecar/salt", SALT_BYTES))
    derived = [DerivedKey(key, derivation) for key, _ in secrets]
    if any(a.equals(b) for a, b in combinations(derived, 2)):
        raise UsageError("two secrets have the same key: each needs its own")
    count = -(-len(secrets) // SLOTS) * SLOTS
    packed = [pack_method(payload.method) + payload.data for _, payload in secrets]
    size = max(encrypted_size(compressed_size(data)) for data in packed)
    header = _HEADER.pack(MAGIC, VERSION, *astuple(derivation), count, _WRAPPED + size)
    slots = []
    for index, (key, data) in enumerate(zip(derived, packed, strict=True)):
        data_key = expand(entropy, f"sidecar/data-key/{index}", DATA_KEY_BYTES)
        wrapped = aes_key_wrap(_wrapping_key(key), data_key)
        slots.append(wrapped + encrypt(data_key, data, header, size=size))
    noise = stream(entropy, "sidecar/noise", (count - len(slots)) * (_WRAPPED + size))
    slots += [noise[i : i + _WRAPPED + size] for i in range(0, len(noise), _WRAPPED + size)]
    order = expand(entropy, "sidecar/order", 4 * count)
    slots = [slots[i] for i in sorted(range(count), key=lambda i: order[4 * i : 4 * i + 4])]
    return header + b"".join(slots)


def decrypt_sidecar(data: bytes, key: str) -> Payload:
    """The payload that `key` opens. Raises WrongKeyError, and InputError for no sidecar."""
    return decrypt_slots(data, DerivedKey(key, read_header(data)[0]))


def read_header(data: bytes) -> tuple[KeyDerivation, int, int]:
    """(key derivation, slots, bytes of a slot). Raises InputError for anything but a whole sidecar."""
    if len(data) < _HEADER.size or not data.startswith(MAGIC):
        raise InputError("not a sidecar of keyss")
    _, version, *costs, count, size = _HEADER.unpack_from(data)
    if version != VERSION:
        raise InputError(f"sidecar of version {version}; this program reads version {VERSION}")
    derivation = KeyDerivation(*costs)
    if not (1 <= count <= MAX_SLOTS and count % SLOTS == 0):
        raise InputError(f"sidecar: expected a multiple of {SLOTS} slots up to {MAX_SLOTS}, got {count}")
    if not _WRAPPED < size <= 2 * MAX_PAYLOAD_BYTES:
        raise InputError(f"sidecar: {size} bytes a slot are out of range")
    if len(data) != _HEADER.size + count * size:
        raise InputError(
            f"not a whole sidecar: expected {_HEADER.size + count * size:,} bytes, got {len(data):,}"
        )
    return derivation, count, size


def decrypt_slots(data: bytes, key: DerivedKey) -> Payload:
    """The payload in the slot that `key` opens; every slot is tried. Errors as for `decrypt_sidecar`."""
    _, _, size = read_header(data)
    header, wrapping_key = data[: _HEADER.size], _wrapping_key(key)
    found: list[tuple[bytes, bytes]] = []
    for start in range(_HEADER.size, len(data), size):
        with suppress(InvalidUnwrap):
            data_key = aes_key_unwrap(wrapping_key, data[start : start + _WRAPPED])
            found.append((data_key, data[start + _WRAPPED : start + size]))
    if not found:
        raise WrongKeyError("this key opens nothing here")
    plain = decrypt(*found[0], header)
    try:
        return Payload(unpack_method(plain), plain[METHOD_BYTES:])
    except ValueError as error:
        raise InputError(f"the encrypted data are damaged: {error}") from error


def _wrapping_key(key: DerivedKey) -> bytes:
    return key.expand("seal", 32)
