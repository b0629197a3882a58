"""Hashes, which hide nothing; pseudo-random numbers and sketches, which are derived from a secret.

By a *sketch* of a model's Gaussians, a reader detects foreign ones: added or changed later. It is the first
bits of a Bloom filter (Bloom 1970) of N bits with one keyed hash, for a model of N Gaussians. The bits of its
own Gaussians are set, so losses do not matter. A foreign Gaussian hits an unset bit with probability
bits / (e N).
"""

from __future__ import annotations

import numpy as np
from cryptography.hazmat.primitives.ciphers import Cipher
from cryptography.hazmat.primitives.ciphers.algorithms import AES
from cryptography.hazmat.primitives.ciphers.modes import ECB

from keyss.core.arrays import Bytes, Doubles, Integers, Numbers, Words
from keyss.keys.derivation import expand, stream

SKETCH_BYTES = 32  # in low bits
_ODD = np.uint64(0x9E3779B97F4A7C15)  # 2^64 / golden ratio: multiples have well-distributed high bits


def mix(words: Words) -> Words:
    """Hash integers of any shape with the finaliser of splitmix64 (Steele et al. 2014)."""
    state = words.astype(np.uint64) + _ODD
    state = (state ^ state >> np.uint64(30)) * np.uint64(0xBF58476D1CE4E5B9)
    state = (state ^ state >> np.uint64(27)) * np.uint64(0x94D049BB133111EB)
    return state ^ state >> np.uint64(31)


def row_hashes(rows: Numbers) -> Words:
    """Hashes [N] of rows of integers [N, C]."""
    found = np.zeros(len(rows), np.uint64)
    for column in rows.T:
        found = (found ^ column.astype(np.uint64)) * _ODD
        found ^= found >> np.uint64(29)
    return found


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
    return random_words(secret, label, count).argsort(kind="stable")


def random_fractions(secret: bytes, label: str, count: int) -> Doubles:
    """Uniform numbers [count] in (0, 1) derived from a secret."""
    words = random_words(secret, label, count) >> np.uint64(12)
    return (words.astype(np.float64) + 0.5) / 2.0**52


def sketch(secret: bytes, ids: Bytes, size: int = SKETCH_BYTES) -> bytes:
    """A sketch of `size` bytes of Gaussians with `ids` [N, 16]."""
    bits = np.zeros(8 * size, np.uint8)
    bits[_places(secret, ids, len(ids), len(bits))] = 1
    return np.packbits(bits, bitorder="little").tobytes()


def foreign(secret: bytes, ids: Bytes, own: bytes, gaussians: int) -> int:
    """Estimated number of `ids` [M, 16] foreign to the sketch `own` of `gaussians` Gaussians."""
    unset = np.unpackbits(np.frombuffer(own, np.uint8), bitorder="little") == 0
    hits = int(unset[_places(secret, ids, gaussians, len(unset))].sum())
    return min(len(ids), round(hits * gaussians / max(1, int(unset[:gaussians].sum()))))


def _places(secret: bytes, ids: Bytes, count: int, kept: int) -> Integers:
    """Bit positions below `kept` that the Gaussians hash to, of `count` positions."""
    hashed = encrypted_blocks(expand(secret, "sketch", 32), ids)[:, :4].copy().view("<u4")[:, 0]
    places = hashed.astype(np.int64) % max(1, count)
    return places[places < kept]
