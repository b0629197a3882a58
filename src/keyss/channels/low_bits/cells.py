"""Cells: a few bytes of each Gaussian, recognisable with the key and noise without. All Gaussians at once.

    tag (4 to 8 bytes), then encrypted: data

A synthetic initialisation vector, as in RFC 5297, for many short messages in one call of AES-256, which takes
20 million blocks a second where a hash for each Gaussian takes a million:

- tag: the first bytes of the CBC-MAC of identity, slot and data. CBC-MAC is a pseudo-random function for
  messages of one length (Bellare, Kilian, Rogaway 2000), and a `CellCipher` takes no others.
- key stream: AES of (seed xor counter), where the seed is AES under another key of (identity xor tag and
  slot). Equal key streams would need equal data in the same Gaussian, or a collision of 128 bits.

Identities are public and differ between Gaussians (see `keyss.channels.low_bits.bits`). So one key may
encrypt different data in one Gaussian, as happens when a model is embedded into twice; an observer notices
nothing but a repetition of the very same bytes. A reader decrypts every cell and keeps those whose tag fits;
with a tag of 4 bytes a foreign cell fits once in 2^32.

Why by hand: no library encrypts a million messages of 70 bytes in one call; the primitive is the library's.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from cryptography.hazmat.primitives.ciphers import Cipher
from cryptography.hazmat.primitives.ciphers.algorithms import AES
from cryptography.hazmat.primitives.ciphers.modes import ECB

from keyss.keys.derivation import expand

TAG_BYTES = 4  # unless more are asked for
_BLOCK = 16
_CELLS = 1 << 13  # at a time: what is made of them stays in the cache

Bytes = npt.NDArray[np.uint8]
Flags = npt.NDArray[np.bool_]


class CellCipher:
    """Encrypts and decrypts cells of `size` bytes of data for one use of a uniformly random `secret`."""

    def __init__(self, secret: bytes, label: str, size: int, tag_bytes: int = TAG_BYTES) -> None:
        self.size = size
        self._tag = tag_bytes
        self._tag_key = expand(secret, f"{label}/tag", 32)
        self._seed_key = expand(secret, f"{label}/seed", 32)
        self._stream_key = expand(secret, f"{label}/stream", 32)

    @property
    def cell_bytes(self) -> int:
        """Bytes of tag and data."""
        return self._tag + self.size

    def encrypt(self, identities: Bytes, data: Bytes, slots: npt.NDArray[np.int64] | int = 0) -> Bytes:
        """[N, cell_bytes] cells of `data` [N, size] for identities [N, 16].

        `slots` [N] or for all of them: which of a Gaussian's cells it is.
        """
        if data.shape != (len(identities), self.size):
            raise ValueError(f"expected data of shape {(len(identities), self.size)}, got {data.shape}")
        numbers: Bytes = np.broadcast_to(np.asarray(slots, np.uint8), len(identities))
        cells = np.empty((len(data), self.cell_bytes), np.uint8)
        for start in range(0, len(data), _CELLS):
            part = slice(start, start + _CELLS)
            tags = self._tags(identities[part], numbers[part], data[part])
            cells[part, : self._tag] = tags
            cells[part, self._tag :] = data[part] ^ self._stream(identities[part], numbers[part], tags)
        return cells

    def decrypt(self, identities: Bytes, cells: Bytes, slot: int = 0) -> tuple[Flags, Bytes]:
        """[N] which of the cells [N, cell_bytes or more] fit this secret, and the data [M, size] of these."""
        fits, found = [np.zeros(0, bool)], [np.zeros((0, self.size), np.uint8)]
        for start in range(0, len(cells), _CELLS):
            part = slice(start, start + _CELLS)
            tags, hidden = cells[part, : self._tag], cells[part, self._tag : self.cell_bytes]
            slots = np.full(len(tags), slot, np.uint8)
            data = hidden ^ self._stream(identities[part], slots, tags)
            fit = (self._tags(identities[part], slots, data) == tags).all(axis=1)
            fits.append(fit)
            found.append(data[fit])
        return np.concatenate(fits), np.concatenate(found)

    def _tags(self, identities: Bytes, slots: Bytes, data: Bytes) -> Bytes:
        message = np.zeros((len(data), -(-(1 + self.size) // _BLOCK) * _BLOCK), np.uint8)
        message[:, 0] = slots
        message[:, 1 : 1 + self.size] = data
        state = _encrypt(self._tag_key, identities)
        for start in range(0, message.shape[1], _BLOCK):
            state = _encrypt(self._tag_key, state ^ message[:, start : start + _BLOCK])
        return state[:, : self._tag]

    def _stream(self, identities: Bytes, slots: Bytes, tags: Bytes) -> Bytes:
        """[N, size] the key streams."""
        seeds = identities.copy()
        seeds[:, : self._tag] ^= tags
        seeds[:, self._tag] ^= slots
        seeds = _encrypt(self._seed_key, seeds)
        blocks = -(-self.size // _BLOCK)
        counted = np.repeat(seeds[:, None], blocks, axis=1)
        counted[:, :, -1] ^= np.arange(blocks, dtype=np.uint8)
        return _encrypt(self._stream_key, counted).reshape(len(tags), -1)[:, : self.size]


def _encrypt(key: bytes, blocks: Bytes) -> Bytes:
    """Every 16 bytes of `blocks` through AES-256: a permutation of blocks, not a mode of operation."""
    plain = np.ascontiguousarray(blocks)
    encrypted = np.empty(plain.size + _BLOCK - 1, np.uint8)  # the library wants room for one more block
    Cipher(AES(key), ECB()).encryptor().update_into(plain.reshape(-1).data, encrypted.data)
    return encrypted[: plain.size].reshape(blocks.shape)
