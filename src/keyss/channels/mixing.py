"""Public hashes, which scatter and hide nothing, and random numbers and orders that follow from a secret."""

from __future__ import annotations

import numpy as np
from cryptography.hazmat.primitives.ciphers import Cipher
from cryptography.hazmat.primitives.ciphers.algorithms import AES
from cryptography.hazmat.primitives.ciphers.modes import ECB

from keyss.core.arrays import Bytes, Doubles, Integers, Numbers, Words
from keyss.keys.derivation import stream

_ODD = np.uint64(0x9E3779B97F4A7C15)  # 2^64 over the golden ratio: the high bits of multiples are scattered


def mix(words: Words) -> Words:
    """[...] numbers that look random for different ones: the finaliser of splitmix64 (Steele et al. 2014)."""
    state = words.astype(np.uint64) + _ODD
    state = (state ^ state >> np.uint64(30)) * np.uint64(0xBF58476D1CE4E5B9)
    state = (state ^ state >> np.uint64(27)) * np.uint64(0x94D049BB133111EB)
    return state ^ state >> np.uint64(31)


def row_hashes(rows: Numbers) -> Words:
    """[N] a hash of each row of integers [N, C]: equal for equal rows, and for others hardly ever."""
    found = np.zeros(len(rows), np.uint64)
    for column in rows.T:
        found = (found ^ column.astype(np.uint64)) * _ODD
        found ^= found >> np.uint64(29)
    return found


def encrypted_blocks(key: bytes, blocks: Bytes) -> Bytes:
    """[..., 16] every block through AES-256: a pseudo-random permutation, not a mode of operation."""
    plain = np.ascontiguousarray(blocks)
    encrypted = np.empty(plain.size + 15, np.uint8)  # the library wants room for one more block
    Cipher(AES(key), ECB()).encryptor().update_into(plain.reshape(-1).data, encrypted.data)
    return encrypted[: plain.size].reshape(blocks.shape)


def random_words(secret: bytes, label: str, count: int) -> Words:
    """[count] uniform integers that follow from a secret."""
    return np.frombuffer(stream(secret, label, 8 * count), "<u8")


def random_order(secret: bytes, label: str, count: int) -> Integers:
    """[count] the numbers from 0 on in an order that follows from a secret."""
    return random_words(secret, label, count).argsort(kind="stable")


def random_fractions(secret: bytes, label: str, count: int) -> Doubles:
    """[count] uniform numbers between 0 and 1, without the ends."""
    words = random_words(secret, label, count) >> np.uint64(12)
    return (words.astype(np.float64) + 0.5) / 2.0**52
