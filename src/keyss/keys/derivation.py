"""Key derivation: Argon2id, then HKDF with a label for each use.

Argon2id (RFC 9106) makes guessing a key expensive. HKDF-SHA256 (RFC 5869) derives everything else from its
result, with labels: no derived value reveals anything about another. Keys are normalised by `normalized_key`.
A master key derives the keys of many named assets.
"""

from __future__ import annotations

import hashlib
import unicodedata
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from argon2.exceptions import HashingError
from argon2.low_level import Type, hash_secret_raw
from cryptography.hazmat.primitives.ciphers import Cipher
from cryptography.hazmat.primitives.ciphers.algorithms import ChaCha20
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.kdf.hkdf import HKDFExpand

from keyss.core.arrays import Bytes
from keyss.core.errors import InputError, UsageError
from keyss.keys.key_file import ALPHABET, LONG_KEY_LENGTH, normalized_key

if TYPE_CHECKING:  # the command line reads options without torch
    import torch
    from torch import Tensor

SALT_BYTES = 16
MASTER_BYTES = 32
EMBEDDING_SIZE = 64
_STREAM_BLOCK = 1 << 16  # bytes
_MASTER_SALT = hashlib.sha256(b"keyss/v1/master").digest()[:SALT_BYTES]
_MAX_NAME_BYTES = 4096
TIME_COST, MEMORY_KIB, PARALLELISM = 3, 64 * 1024, 4  # Argon2id: passes, KiB, lanes


def expand(secret: bytes, label: str, length: int) -> bytes:
    """`length` bytes for one use of a uniformly random `secret`: HKDF-Expand with SHA-256 (RFC 5869)."""
    return HKDFExpand(SHA256(), length, f"keyss/v1/{label}".encode()).derive(secret)


def stream(secret: bytes, label: str, length: int) -> bytes:
    """`expand` for any length: the key stream of ChaCha20 (RFC 8439) under a derived key."""
    data = np.empty(length, np.uint8)
    fill(secret, label, data)
    return data.tobytes()


def fill(secret: bytes, label: str, data: Bytes) -> None:
    """Overwrite contiguous `data` with the bytes of `stream`."""
    encryptor = Cipher(ChaCha20(expand(secret, label, 32), bytes(16)), mode=None).encryptor()
    flat, zeros = data.reshape(-1).data, bytes(_STREAM_BLOCK)
    for start in range(0, len(flat), _STREAM_BLOCK):
        part = flat[start : start + _STREAM_BLOCK]
        encryptor.update_into(zeros[: len(part)], part)


@lru_cache(maxsize=256)  # hiding derives keys that it needs again to check the result
def _argon2id(key: bytes, salt: bytes) -> bytes:
    costs = {"time_cost": TIME_COST, "memory_cost": MEMORY_KIB, "parallelism": PARALLELISM}
    return hash_secret_raw(key, salt, **costs, hash_len=MASTER_BYTES, type=Type.ID)


@dataclass(frozen=True, eq=False, repr=False)
class DerivedKey:
    """A key after Argon2id with one salt, and the values that follow from it.

    Labels in use: "embedding" (conditions the decoder), "verifier" (compares keys), "channel/key" (decrypts
    what a channel holds), "writer" (randomness of hiding).
    """

    master: bytes  # MASTER_BYTES, the output of Argon2id

    @staticmethod
    def of(key: str, salt: bytes) -> DerivedKey:
        """Derive a key under a salt of SALT_BYTES, in about 0.1 s.

        Raises UsageError as `normalized_key` does, InputError for another salt, and without enough memory.
        """
        text = normalized_key(key)
        if len(salt) != SALT_BYTES:
            raise InputError(f"key derivation: expected a salt of {SALT_BYTES} bytes, got {len(salt)}")
        try:
            master = _argon2id(text.encode(), salt)
        except HashingError as error:
            raise InputError(
                f"deriving a key needs {MEMORY_KIB // 1024} MiB of memory, which the system refuses: {error}"
            ) from error
        return DerivedKey(master)

    def expand(self, label: str, length: int) -> bytes:
        """`length` bytes for the use that `label` names."""
        return expand(self.master, label, length)

    def verifier(self) -> bytes:
        """32 bytes that identify the key and reveal nothing about its embedding."""
        return self.expand("verifier", 32)

    def embedding(self) -> Tensor:
        """[64] float32 unit vector, uniform on the sphere, which conditions the decoder."""
        import torch
        from scipy.special import ndtri  # slower to load than a key is to derive

        words = np.frombuffer(self.expand("embedding", 8 * EMBEDDING_SIZE), "<u8")
        uniform = (words.astype(np.float64) + 0.5) / 2.0**64
        return unit_vector(torch.from_numpy(ndtri(uniform.clip(1e-16, 1 - 1e-16))))


class MasterKey:
    """One key from which the keys of many named assets derive, each in next to no time.

    A fixed salt lets the master key and a name suffice to open an asset; guessing the master key from a
    derived key is as slow as guessing any key. Equal master keys give equal keys everywhere, and a fixed salt
    allows guesses in advance: use a key of `keyss keygen` as a master key, not a password.
    """

    def __init__(self, key: str) -> None:
        self._derived = DerivedKey.of(key, _MASTER_SALT)

    def key_of(self, name: str) -> str:
        """The key of a name: 22 letters and digits.

        Names are normalised to NFC. Raises UsageError for a name that is empty, not text, or too long.
        """
        if len(name) > _MAX_NAME_BYTES:  # normalising takes quadratic time
            raise UsageError(f"expected a name of 1 to {_MAX_NAME_BYTES} bytes, got {len(name)} characters")
        try:
            data = unicodedata.normalize("NFC", name).encode()
        except UnicodeEncodeError as error:
            raise UsageError(f"{name!r}: expected a name in UTF-8") from error
        if not 1 <= len(data) <= _MAX_NAME_BYTES:
            raise UsageError(f"expected a name of 1 to {_MAX_NAME_BYTES} bytes, got {len(data)}")
        # Hashed, so that no name can imitate the label of another use.
        label = f"master/{hashlib.sha256(data).hexdigest()}"
        number = int.from_bytes(self._derived.expand(label, 32), "big")
        characters = []
        for _ in range(LONG_KEY_LENGTH):  # 131 of 256 bits: uniform to 2^-125
            number, digit = divmod(number, len(ALPHABET))
            characters.append(ALPHABET[digit])
        return "".join(characters)


def unit_vector(normal: Tensor) -> Tensor:
    """float32 direction of a vector of independent normal numbers [..., 64]."""
    length: Tensor = normal.norm(dim=-1, keepdim=True)
    return (normal / length).float()


def random_embeddings(count: int, generator: torch.Generator, size: int = EMBEDDING_SIZE) -> Tensor:
    """[count, size] embeddings of random keys: independent uniform unit vectors."""
    import torch

    return unit_vector(torch.randn(count, size, generator=generator, dtype=torch.float64))
