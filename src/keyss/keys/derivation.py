"""From what a person types to what the method needs: Argon2id, then HKDF with a label per use.

The key itself is used once, in Argon2id (RFC 9106), which makes guessing expensive; everything else is
derived from its result by HKDF-SHA256 (RFC 5869) with labels, so that no derived value tells anything of
another. A key is text as `normalized_key` gives it, so one key typed on two systems is one key.
"""

from __future__ import annotations

import hmac
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from argon2.exceptions import HashingError
from argon2.low_level import Type, hash_secret_raw
from cryptography.hazmat.primitives.ciphers import Cipher
from cryptography.hazmat.primitives.ciphers.algorithms import ChaCha20
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.kdf.hkdf import HKDFExpand
from torch import Tensor

from keyss.core.errors import InputError
from keyss.keys.key_file import normalized_key

SALT_BYTES = 16
MASTER_BYTES = 32
EMBEDDING_SIZE = 64
_STREAM_BLOCK = 1 << 16  # bytes that are made at a time


TIME_COST, MEMORY_KIB, PARALLELISM = 3, 64 * 1024, 4
MAX_FACTOR = 4  # a file may ask for so many times the memory and the work of this program's own
MAX_PASSES = 4


@dataclass(frozen=True)
class KeyDerivation:
    """Argon2id's public parameters; what a file states is held to a floor and a ceiling."""

    salt: bytes
    time_cost: int = TIME_COST  # passes
    memory_kib: int = MEMORY_KIB
    parallelism: int = PARALLELISM

    def __post_init__(self) -> None:
        if len(self.salt) != SALT_BYTES:
            raise InputError(f"key derivation: expected a salt of {SALT_BYTES} bytes, got {len(self.salt)}")
        ranges = (
            ("time_cost", 1, MAX_PASSES),
            ("memory_kib", 8 * 1024, MAX_FACTOR * MEMORY_KIB),
            ("parallelism", 1, 16),
        )
        for name, low, high in ranges:
            value = getattr(self, name)
            if not (type(value) is int and low <= value <= high):
                raise InputError(f"key derivation: expected {name} in {low} to {high}, got {value!r}")
        work, most = self.time_cost * self.memory_kib, MAX_FACTOR * TIME_COST * MEMORY_KIB
        if work > most:
            raise InputError(
                f"key derivation: expected passes times KiB of at most {most:,}, {MAX_FACTOR} times what "
                f"this program asks for, got {self.time_cost} times {self.memory_kib:,}"
            )


def expand(secret: bytes, label: str, length: int) -> bytes:
    """`length` bytes for one use of a uniformly random `secret`: HKDF-Expand with SHA-256 (RFC 5869)."""
    return HKDFExpand(SHA256(), length, f"keyss/v1/{label}".encode()).derive(secret)


def stream(secret: bytes, label: str, length: int) -> bytes:
    """The same for more bytes than HKDF gives: the key stream of ChaCha20 (RFC 8439) under a derived key."""
    data = np.empty(length, np.uint8)
    fill(secret, label, data)
    return data.tobytes()


def fill(secret: bytes, label: str, data: npt.NDArray[np.uint8]) -> None:
    """Overwrite contiguous `data` with what `stream` gives."""
    encryptor = Cipher(ChaCha20(expand(secret, label, 32), bytes(16)), mode=None).encryptor()
    flat, zeros = data.reshape(-1).data, bytes(_STREAM_BLOCK)
    for start in range(0, len(flat), _STREAM_BLOCK):
        part = flat[start : start + _STREAM_BLOCK]
        encryptor.update_into(zeros[: len(part)], part)


class DerivedKey:
    """What a key becomes under one `KeyDerivation`.

    The labels in use: "embedding" (what conditions the decoder), "verifier" (tells keys apart while hiding),
    "low-bits/key" (encrypts the data key in a model's low bits), "writer" (part of the writer's randomness),
    "decoy", and those of the other channels.
    """

    def __init__(self, key: str, derivation: KeyDerivation) -> None:
        """Takes about 0.1 s. Raises UsageError as `normalized_key` does, InputError without memory."""
        text = normalized_key(key)
        try:
            self._master = hash_secret_raw(
                text.encode(),
                derivation.salt,
                time_cost=derivation.time_cost,
                memory_cost=derivation.memory_kib,
                parallelism=derivation.parallelism,
                hash_len=MASTER_BYTES,
                type=Type.ID,
            )
        except HashingError as error:
            raise InputError(
                f"deriving a key takes {derivation.memory_kib // 1024} MiB of memory, which the system does "
                f"not give: {error}"
            ) from error

    @staticmethod
    def of_master(master: bytes) -> DerivedKey:
        """The key whose Argon2id output is `master` (32 bytes): for tests that try thousands of keys."""
        if len(master) != MASTER_BYTES:
            raise ValueError(f"expected {MASTER_BYTES} bytes, got {len(master)}")
        derived = object.__new__(DerivedKey)
        derived._master = master
        return derived

    def expand(self, label: str, length: int) -> bytes:
        """`length` bytes for the use that `label` names."""
        return expand(self._master, label, length)

    def verifier(self) -> bytes:
        """32 bytes that recognise the key and say nothing of its embedding."""
        return self.expand("verifier", 32)

    def equals(self, other: DerivedKey) -> bool:
        """Whether both come from the same key and derivation, in constant time."""
        return hmac.compare_digest(self.verifier(), other.verifier())

    def embedding(self) -> Tensor:
        """[64] float32 unit vector, uniform on the sphere over keys: what the decoder is conditioned on."""
        from scipy.special import ndtri  # takes longer to load than a key takes to derive

        words = np.frombuffer(self.expand("embedding", 8 * EMBEDDING_SIZE), "<u8")
        uniform = (words.astype(np.float64) + 0.5) / 2.0**64
        return unit_vector(torch.from_numpy(ndtri(uniform.clip(1e-16, 1 - 1e-16))))


def unit_vector(normal: Tensor) -> Tensor:
    """float32 direction of a vector of independent normal numbers [..., 64]."""
    length: Tensor = normal.norm(dim=-1, keepdim=True)
    return (normal / length).float()


def random_embeddings(count: int, generator: torch.Generator) -> Tensor:
    """[count, 64] what fresh wrong keys become: independent uniform unit vectors."""
    return unit_vector(torch.randn(count, EMBEDDING_SIZE, generator=generator, dtype=torch.float64))
