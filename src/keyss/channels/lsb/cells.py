"""Cells: a few bytes of each carrier, recognisable with the key and indistinguishable from noise without it.

    tag (4 bytes), then encrypted: data

A synthetic initialisation vector, as in RFC 5297, for many short messages in one call of AES-256, which takes
20 million blocks a second where hashes take a million Gaussians:

- tag: the first bytes of the CBC-MAC of carrier ID and data. CBC-MAC is a pseudo-random function for
  messages of one length (Bellare, Kilian, Rogaway 2000), and a `CellCipher` takes no others.
- key stream: AES of (seed xor counter), where the seed is AES under another key of (ID xor tag).
  Equal key streams would need equal data in the same carrier, or a collision of 128 bits.

Carrier IDs are public and unique (see `bits`). One key may encrypt different data in the same carrier, as
when a model is embedded into twice: only a repetition of identical data shows. A reader decrypts every cell
and keeps those with a valid tag; a cell of another key has one with probability 2^-32.

The mode is written by hand because no library encrypts a million messages of 70 bytes in one call; the
primitive is the library's.
"""

from __future__ import annotations

import numpy as np

from keyss.channels.mixing import encrypted_blocks
from keyss.core.arrays import Bytes, Flags
from keyss.kernels.parallel import in_blocks
from keyss.keys.derivation import expand

TAG_BYTES = 4
_BLOCK = 16
_CELLS = 1 << 13  # at a time: what is made of them stays in the cache


class CellCipher:
    """Encrypts and decrypts cells of `size` bytes of data for one use of a uniformly random `secret`."""

    def __init__(self, secret: bytes, label: str, size: int) -> None:
        self.size = size
        self._tag_key = expand(secret, f"{label}/tag", 32)
        self._seed_key = expand(secret, f"{label}/seed", 32)
        self._stream_key = expand(secret, f"{label}/stream", 32)

    @property
    def cell_bytes(self) -> int:
        """Bytes of tag and data."""
        return TAG_BYTES + self.size

    def encrypt(self, ids: Bytes, data: Bytes) -> Bytes:
        """[N, cell_bytes] cells of `data` [N, size] for carrier `ids` [N, 16]."""
        if data.shape != (len(ids), self.size):
            raise ValueError(f"expected data of shape {(len(ids), self.size)}, got {data.shape}")
        cells = np.empty((len(data), self.cell_bytes), np.uint8)

        def work(start: int, stop: int) -> None:
            part, own = ids[start:stop], data[start:stop]
            tags = self._tags(part, own)
            cells[start:stop, :TAG_BYTES] = tags
            cells[start:stop, TAG_BYTES:] = own ^ self._stream(part, tags)

        in_blocks(work, len(data), _CELLS)
        return cells

    def decrypt(self, ids: Bytes, cells: Bytes) -> tuple[Flags, Bytes]:
        """[N] which of the cells [N, cell_bytes or more] fit this secret, and the data [M, size] of these."""
        fits = np.zeros(len(cells), bool)

        def work(start: int, stop: int) -> Bytes:
            part, own = ids[start:stop], cells[start:stop, : self.cell_bytes]
            tags = own[:, :TAG_BYTES]
            data = own[:, TAG_BYTES:] ^ self._stream(part, tags)
            fits[start:stop] = (self._tags(part, data) == tags).all(axis=1)
            return data[fits[start:stop]]

        every = in_blocks(work, len(cells), _CELLS)
        return fits, np.concatenate([np.zeros((0, self.size), np.uint8), *every])

    def _tags(self, ids: Bytes, data: Bytes) -> Bytes:
        """[N, TAG_BYTES] of data [N, size]."""
        messages = np.zeros((len(data), -(-self.size // _BLOCK), _BLOCK), np.uint8)
        messages.reshape(len(data), -1)[:, : self.size] = data
        states = encrypted_blocks(self._tag_key, ids)
        for block in range(messages.shape[1]):
            states = encrypted_blocks(self._tag_key, states ^ messages[:, block])
        return states[:, :TAG_BYTES]

    def _stream(self, ids: Bytes, tags: Bytes) -> Bytes:
        """[N, size] the key streams; `tags` [N, TAG_BYTES]."""
        seeds = ids.copy()
        seeds[:, :TAG_BYTES] ^= tags
        counted = np.repeat(encrypted_blocks(self._seed_key, seeds)[:, None], -(-self.size // _BLOCK), axis=1)
        counted[:, :, -1] ^= np.arange(counted.shape[1], dtype=np.uint8)
        return encrypted_blocks(self._stream_key, counted).reshape(len(seeds), -1)[:, : self.size]
