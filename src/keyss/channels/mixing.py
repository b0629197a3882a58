"""Hashes, which hide nothing; pseudo-random numbers, which are derived from a secret."""

from __future__ import annotations

import numpy as np
from cryptography.hazmat.primitives.ciphers import Cipher
from cryptography.hazmat.primitives.ciphers.algorithms import AES
from cryptography.hazmat.primitives.ciphers.modes import ECB

from keyss.core.arrays import Bytes, Doubles, Integers, Numbers, Words
from keyss.keys.derivation import stream

_ODD = np.uint64(0x9E3779B97F4A7C15)  # 2^64 / golden ratio: multiples have well-distributed high bits


def mix(words: Words) -> Words:
    """Hash integers of any shape with the finaliser of splitmix64 (Steele et al. 2014)."""
    state = words.astype(np.uint64) + _ODD
    state = (state ^ state >> np.uint64(30)) * np.uint64(0xBF58476D1CE4E5B9)
    state = (state ^ state >> np.uint64(27)) * np.uint64(0x94D049BB133111EB)
    return state ^ state >> np.uint64(31)


def row_hashes(rows: Numbers) -> Words:
    """Hashes [N] of rows of integers [N, C]."""
    hashes = np.zeros(len(rows), np.uint64)
    for column in rows.T:
        hashes = (hashes ^ column.astype(np.uint64)) * _ODD
        hashes ^= hashes >> np.uint64(29)
    return hashes


def encrypted_blocks(key: bytes, blocks: Bytes) -> Bytes:
    """Encrypt each block [..., 16] by AES-256 as a pseudo-random permutation, not as a mode of operation."""
    plain = np.ascontiguousarray(blocks)
    encrypted = np.empty(plain.size + 15, np.uint8)  # `update_into` requires room for another block
    Cipher(AES(key), ECB()).encryptor().update_into(plain.reshape(-1).data, encrypted.data)
    return encrypted[: plain.size].reshape(blocks.shape)


def random_words(secret: bytes, label: str, count: int) -> Words:
    """Uniform integers [count] derived from a secret."""
    return np.frombuffer(stream(secret, label, 8 * count), "<u8")


def random_order(secret: bytes, label: str, count: int) -> Integers:
    """A permutation [count] derived from a secret."""
    # Sorted with their numbers in the lower half: the same on all machines, and faster than `argsort`.
    lower = np.uint64(2**32 - 1)
    words = random_words(secret, label, count) & ~lower | np.arange(count, dtype=np.uint64)
    return (np.sort(words) & lower).astype(np.int64)


def random_fractions(secret: bytes, label: str, count: int) -> Doubles:
    """Uniform numbers [count] in (0, 1) derived from a secret."""
    words = random_words(secret, label, count) >> np.uint64(12)
    return (words.astype(np.float64) + 0.5) / 2.0**52
