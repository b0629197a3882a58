"""Hashes, which hide nothing; pseudo-random numbers and Bloom filters, which are derived from a secret.

By a *Bloom filter* (Bloom 1970) of a model's Gaussians, a reader detects foreign ones: added or changed
later. It has B bits and one keyed hash. Each Gaussian hashes to one of `among` places, and those
below B are bits: a sample of the Gaussians, in which each is present with probability B / `among`. The bits
of its own Gaussians are set, so losses do not matter. Of foreign ones in the sample, a share e^-1 hits unset
bits if the filter holds B Gaussians. Equal IDs count once.
"""

from __future__ import annotations

import math

import numpy as np
from cryptography.hazmat.primitives.ciphers import Cipher
from cryptography.hazmat.primitives.ciphers.algorithms import AES
from cryptography.hazmat.primitives.ciphers.modes import ECB

from keyss.core.arrays import Bytes, Doubles, Integers, Numbers, Words
from keyss.keys.derivation import expand, stream

BLOOM_BYTES = 32  # in low bits
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


def bloom_filter(secret: bytes, ids: Bytes, size: int = BLOOM_BYTES, among: Integers | None = None) -> bytes:
    """A Bloom filter of `size` bytes of Gaussians with `ids` [N, 16].

    `among` [N]: places that each hashes to, a function of its ID; by default N.
    """
    bits = np.zeros(8 * size, np.uint8)
    bits[_places(secret, ids, len(ids) if among is None else among, len(bits))] = 1
    return np.packbits(bits, bitorder="little").tobytes()


def foreign_share(secret: bytes, ids: Bytes, own: bytes, among: Integers | int, gone: float = 0.0) -> float:
    """Estimated share, 0 to 1, of foreign Gaussians among those with `ids` [M, 16], by the filter `own`.

    `among` [M]: as in `bloom_filter`, if Gaussians count in inverse proportion to it; else the number of its
    Gaussians. 1 if less than a share `gone` of the Bloom filter's sample, rounded down, is there.
    """
    unset = np.unpackbits(np.frombuffer(own, np.uint8), bitorder="little") == 0
    places = _places(secret, ids, among, len(unset))
    if isinstance(among, int):
        unset = unset[:among]
    if len(places) < math.floor(gone * (~unset).sum()):
        return 1.0
    return min(1.0, float(unset[places].sum() / max(1e-9, len(places) * unset.mean())))


def _places(secret: bytes, ids: Bytes, among: Integers | int, kept: int) -> Integers:
    """Places below `kept` [P] of different IDs."""
    hashed = encrypted_blocks(expand(secret, "bloom", 32), ids)[:, :8].copy().view("<u4").astype(np.int64)
    places = hashed[:, 0] % np.maximum(1, among)
    sampled = np.flatnonzero(places < kept)
    _, first = np.unique(hashed[sampled, 0] << 32 | hashed[sampled, 1], return_index=True)
    return places[sampled[first]]
