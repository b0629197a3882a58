"""The sidecar: sealed payloads in a file of their own, for models whose low bits will not survive.

    magic "KEYSSEAL", version (1 byte), Argon2id: salt (16), passes (1), KiB (4), lanes (1);
    slots (2), bytes of a slot (4); then the slots

A slot is a data key wrapped under the key's master (AES key wrap, RFC 3394, 40 bytes) and the payload sealed
under it, with everything before the slots as associated data. There are four slots, or eight for five
secrets and so on; those not in use hold random bytes, which nobody can tell from a sealed payload without
its key. A reader tries its key on every slot. Numbers are little-endian.
"""

from __future__ import annotations

import secrets as system_random
import struct
from collections.abc import Sequence
from itertools import combinations

from cryptography.hazmat.primitives.keywrap import InvalidUnwrap, aes_key_unwrap, aes_key_wrap

from keyss.core.errors import InputError, UsageError, WrongKeyError
from keyss.keys.derivation import SALT_BYTES, DerivedKey, KeyDerivation, expand, stream
from keyss.keys.sealed import DATA_KEY_BYTES, MAX_PAYLOAD_BYTES, compressed_size, seal, sealed_size, unseal

MAGIC = b"KEYSSEAL"
VERSION = 1
SLOTS = 4  # or a multiple of it
MAX_SLOTS = 256
_HEADER = struct.Struct("<8sB16sBIBHI")
_WRAPPED = DATA_KEY_BYTES + 8


def seal_sidecar(secrets: Sequence[tuple[str, bytes]], *, entropy: bytes | None = None) -> bytes:
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
    size = max(sealed_size(compressed_size(payload)) for _, payload in secrets)
    header = _pack_header(derivation, count, _WRAPPED + size)
    slots = []
    for index, (key, (_, payload)) in enumerate(zip(derived, secrets, strict=True)):
        data_key = expand(entropy, f"sidecar/data-key/{index}", DATA_KEY_BYTES)
        wrapped = aes_key_wrap(_wrapping_key(key), data_key)
        slots.append(wrapped + seal(data_key, payload, header, size=size))
    noise = stream(entropy, "sidecar/noise", (count - len(slots)) * (_WRAPPED + size))
    slots += [noise[i : i + _WRAPPED + size] for i in range(0, len(noise), _WRAPPED + size)]
    order = expand(entropy, "sidecar/order", 4 * count)
    slots = [slots[i] for i in sorted(range(count), key=lambda i: order[4 * i : 4 * i + 4])]
    return header + b"".join(slots)


def unseal_sidecar(data: bytes, key: str) -> bytes:
    """The payload that `key` opens. Raises WrongKeyError, and InputError for no sidecar."""
    return open_slots(data, DerivedKey(key, read_header(data)[0]))


def read_header(data: bytes) -> tuple[KeyDerivation, int, int]:
    """(key derivation, slots, bytes of a slot). Raises InputError for anything but a whole sidecar."""
    if len(data) < _HEADER.size or not data.startswith(MAGIC):
        raise InputError("not a sealed decoder of keyss")
    _, version, salt, passes, kib, lanes, count, size = _HEADER.unpack_from(data)
    if version != VERSION:
        raise InputError(f"sealed decoder of version {version}; this program reads version {VERSION}")
    derivation = KeyDerivation(salt=salt, time_cost=passes, memory_kib=kib, parallelism=lanes)
    if not (1 <= count <= MAX_SLOTS and count % SLOTS == 0):
        raise InputError(
            f"sealed decoder: expected a multiple of {SLOTS} slots up to {MAX_SLOTS}, got {count}"
        )
    if not _WRAPPED < size <= 2 * MAX_PAYLOAD_BYTES:
        raise InputError(f"sealed decoder: {size} bytes a slot are out of range")
    if len(data) != _HEADER.size + count * size:
        raise InputError(
            f"not a whole sealed decoder: expected {_HEADER.size + count * size:,} bytes, got {len(data):,}"
        )
    return derivation, count, size


def open_slots(data: bytes, key: DerivedKey) -> bytes:
    """The payload in the slot that `key` opens; every slot is tried. Errors as for `unseal_sidecar`."""
    _, count, size = read_header(data)
    header, wrapping_key = data[: _HEADER.size], _wrapping_key(key)
    found: list[tuple[bytes, bytes]] = []
    for index in range(count):
        start = _HEADER.size + index * size
        wrapped, sealed = data[start : start + _WRAPPED], data[start + _WRAPPED : start + size]
        try:
            found.append((aes_key_unwrap(wrapping_key, wrapped), sealed))
        except InvalidUnwrap:
            continue
    if not found:
        raise WrongKeyError("this key opens nothing here")
    data_key, sealed = found[0]
    return unseal(data_key, sealed, header)


def _pack_header(derivation: KeyDerivation, count: int, size: int) -> bytes:
    return _HEADER.pack(
        MAGIC,
        VERSION,
        derivation.salt,
        derivation.time_cost,
        derivation.memory_kib,
        derivation.parallelism,
        count,
        size,
    )


def _wrapping_key(key: DerivedKey) -> bytes:
    return key.expand("seal", 32)
