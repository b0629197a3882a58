"""The container of every channel (docs/byte-layout.md): from a payload to sealed bytes and shards, and back.

Sealed bytes begin with a *record*, by which a reader detects foreign Gaussians (see `foreign`). Where a
channel may lose slots, Reed-Solomon divides them into shards with redundancy (`reed_solomon`).

All randomness is derived from `entropy`, which must be secret: otherwise the holder of one key could compute
the file without the other secrets and compare. A salt depends on the file, in colours on its cover, so
guessing a key takes a run of Argon2id for each. No key stream is used twice: data keys depend on entropy and
all payloads.
"""

from __future__ import annotations

import hashlib
import os
import struct
import warnings
from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np

from keyss.channels.reed_solomon import Codewords
from keyss.core.arrays import Bytes, Integers
from keyss.core.errors import InputError, KeyssWarning, UsageError, WrongKeyError, of_other_version
from keyss.keys.derivation import DerivedKey, expand, stream
from keyss.keys.encryption import OVERHEAD, compressed_size, decrypt, encrypt

METHOD_BYTES = 15  # maximum length of a method's name
MAX_OVERHEAD = OVERHEAD + METHOD_BYTES + 1  # bytes of a sealed payload beside its data and record, at most
SALTS_TRIED = 4  # if half of the Gaussians changed, all four salts did in one of 16 models
_NOT_INDEPENDENT = (
    "the secrets are too large, or too many, to be placed independently of each other: whoever holds one of "
    "the keys can notice that there are other secrets"
)
_FOREIGN = (
    "about {:,} Gaussians were added to the file or changed after the secret was hidden, so an attacker may "
    "have chosen which secret the key opens: reveal it from the file as it was published"
)
_ASSOCIATED = b"keyss/v1/payload"  # authenticated with a payload
_VERSION = 1
_CHECK_BYTES = 8
_PARAMETERS = struct.Struct("<BBIHH")
PARAMETER_BYTES = _CHECK_BYTES + _PARAMETERS.size


@dataclass(frozen=True)
class Payload:
    """Bytes that are read completely or not at all."""

    method: str  # 1 to METHOD_BYTES ASCII characters
    data: bytes
    shards: tuple[int, int] | None = field(default=None, compare=False)  # read and written; None: not divided
    model_size: int | None = field(default=None, compare=False)  # Gaussians of the model it was read from
    foreign: int = field(default=0, compare=False)  # estimate of those added or changed after hiding


def pack_payload(payload: Payload) -> bytes:
    """Name of the method, zero byte, data."""
    return payload.method.encode("ascii") + b"\0" + payload.data


def unpack_payload(packed: bytes) -> Payload:
    """Invert `pack_payload`. Raises InputError for anything else."""
    name, zero, data = packed.partition(b"\0")
    if not (zero and name.isascii() and 1 <= len(name) <= METHOD_BYTES):
        raise InputError("the hidden data are damaged: they do not begin with a method's name")
    return Payload(name.decode("ascii"), data)


def sealed_size(payload: Payload, record_bytes: int = 0) -> int:
    """The least size of a sealed payload, in bytes."""
    return record_bytes + compressed_size(pack_payload(payload)) + OVERHEAD


def seal(data_key: bytes, payload: Payload, size: int, record: bytes = b"") -> bytes:
    """`size` bytes, at least `sealed_size`: the record, then the payload; authenticated together."""
    encrypted = encrypt(
        expand(data_key, "payload-key", 32),
        pack_payload(payload),
        _ASSOCIATED + record,
        size=size - len(record),
    )
    return _masked(data_key, record) + encrypted


def unseal(data_key: bytes, sealed: bytes | memoryview, record_bytes: int = 0) -> tuple[bytes, Payload]:
    """The record and the payload. Raises InputError for damage."""
    record = _masked(data_key, sealed[:record_bytes])
    packed = decrypt(expand(data_key, "payload-key", 32), sealed[record_bytes:], _ASSOCIATED + record)
    return record, unpack_payload(packed)


def _masked(data_key: bytes, record: bytes | memoryview) -> bytes:
    """A record, encrypted or decrypted."""
    mask = np.frombuffer(stream(data_key, "record", len(record)), np.uint8)
    return (np.frombuffer(record, np.uint8) ^ mask).tobytes()


def unseal_shards(
    data_key: bytes, codewords: Codewords, numbers: Integers, shards: Bytes, record_bytes: int
) -> tuple[bytes, Payload]:
    """`unseal` from shards [C, width] with `numbers` [C]. Raises InputError if too few are left.

    Looks for false shards only if authentication fails.
    """
    with suppress(InputError):
        return unseal(data_key, codewords.decode(numbers, shards), record_bytes)
    return unseal(data_key, codewords.decode(numbers, shards, errors=True), record_bytes)


@dataclass(frozen=True)
class Parameters:
    """How the shards of a payload lie in slots. Unpacked ones may be impossible."""

    depth: int  # what shards take of each slot: bits of each number, or bytes of a block
    count: int  # codewords
    n: int = 1  # shards of a codeword
    k: int = 1  # data shards of a codeword

    def pack(self, data_key: bytes) -> bytes:
        return check_of(data_key) + _PARAMETERS.pack(_VERSION, self.depth, self.count, self.n, self.k)

    @staticmethod
    def unpack(packed: bytes, data_key: bytes) -> Parameters | None:
        """None if the data key is wrong. Raises InputError for another version."""
        if packed[:_CHECK_BYTES] != check_of(data_key):
            return None
        version, *fields = _PARAMETERS.unpack_from(packed, _CHECK_BYTES)
        if version != _VERSION:
            raise InputError(of_other_version(version, _VERSION))
        return Parameters(*fields)


def check_of(data_key: bytes) -> bytes:
    """The first bytes of parameters."""
    return expand(data_key, "check", _CHECK_BYTES)


class SaltedReader(ABC):
    """Reads the secrets of a stego model: tries a key with one salt of Argon2id after another."""

    salts: Sequence[bytes]  # the likeliest first

    @abstractmethod
    def extract(self, key: DerivedKey) -> Payload:
        """`open`, after key derivation with one salt, without a warning.

        A wrong key takes as long as a right one, but for the payload's decryption.
        """

    def open(self, key: str) -> Payload:
        """The payload that `key` opens. Raises WrongKeyError if it opens nothing, InputError for damage.

        Changed or added Gaussians can replace the first salt, so several are tried, each in 0.1 s. Warns as
        `warned` does.
        """
        for salt in self.salts[:SALTS_TRIED]:
            with suppress(WrongKeyError):
                return warned(self.extract(DerivedKey.of(key, salt)))
        raise WrongKeyError()


def warned(payload: Payload) -> Payload:
    """The payload; warns (KeyssWarning) of Gaussians that were added or changed after hiding."""
    if payload.foreign:
        warnings.warn(_FOREIGN.format(payload.foreign), KeyssWarning, stacklevel=4)
    return payload


def warn_of_others(why: str = _NOT_INDEPENDENT) -> None:
    """Warn (KeyssWarning) that the holder of one key can tell that there are other secrets."""
    warnings.warn(why, KeyssWarning, stacklevel=5)


def key_secret(key: DerivedKey) -> bytes:
    """What a key under a salt decrypts with. It is the data key of a file with one salt."""
    return key.expand("channel/key", 32)


def randomness(entropy: bytes | None, payloads: Sequence[Payload], cover: bytes = b"") -> bytes:
    """32 bytes derived from `entropy`, all payloads and the cover, so that no two files share derived values.

    `entropy`: at least 32 secret bytes; None: the system's. `cover`: its bytes, or a hash.
    """
    entropy = os.urandom(32) if entropy is None else entropy
    if len(entropy) < 32:
        raise ValueError(f"expected at least 32 bytes of entropy, got {len(entropy)}")
    parts = (entropy, cover, *map(pack_payload, payloads))
    return hashlib.sha256(b"".join(hashlib.sha256(part).digest() for part in parts)).digest()


def check_keys(keys: Sequence[bytes]) -> None:
    """Raise UsageError unless there is a key, and no two are equal."""
    if not keys or len(set(keys)) < len(keys):
        raise UsageError("two secrets have the same key: expected at least one secret, each with its own")
