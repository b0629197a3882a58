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

from keyss.channels.low_bits import cell_kernels as kernels
from keyss.keys.derivation import expand
from keyss.rendering.cpu.parallel import in_blocks

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
        numbers = np.atleast_1d(np.asarray(slots, np.uint8))
        cells = np.empty((len(data), self.cell_bytes), np.uint8)

        def work(start: int, stop: int) -> None:
            names, own, out = identities[start:stop], data[start:stop], cells[start:stop]
            which = numbers[start:stop] if len(numbers) > 1 else numbers
            messages = self._messages(len(own))
            kernels.begin(which, own, messages)
            tags = self._tags(names, messages)
            out[:, : self._tag] = tags[:, : self._tag]
            kernels.cover(own, 0, self._stream(names, which, tags), out, self._tag)

        in_blocks(work, len(data), _CELLS)
        return cells

    def decrypt(self, identities: Bytes, cells: Bytes, slot: int = 0) -> tuple[Flags, Bytes]:
        """[N] which of the cells [N, cell_bytes or more] fit this secret, and the data [M, size] of these."""
        fits, which = np.zeros(len(cells), bool), np.array([slot], np.uint8)

        def work(start: int, stop: int) -> Bytes:
            names = identities[start:stop]
            hidden = np.ascontiguousarray(cells[start:stop, : self.cell_bytes])
            messages = self._messages(len(names))
            messages[:, 0], messages[:, 1 + self.size :] = slot, 0
            kernels.cover(hidden, self._tag, self._stream(names, which, hidden), messages, 1)
            rows, opened = np.empty(len(names), np.int64), np.empty((len(names), self.size), np.uint8)
            tags = self._tags(names, messages)
            count = kernels.fit(tags, hidden, self._tag, messages, self.size, rows, opened)
            fits[start + rows[:count]] = True
            return opened[:count].copy()

        return fits, np.concatenate(
            [np.zeros((0, self.size), np.uint8), *in_blocks(work, len(cells), _CELLS)]
        )

    def _messages(self, count: int) -> Bytes:
        return np.empty((count, -(-(1 + self.size) // _BLOCK) * _BLOCK), np.uint8)

    def _tags(self, identities: Bytes, messages: Bytes) -> Bytes:
        """[N, 16] of which a tag is the first bytes."""
        states = _encrypt(self._tag_key, identities)
        for block in range(messages.shape[1] // _BLOCK):
            kernels.chain(states, messages, block)
            states = _encrypt(self._tag_key, states)
        return states

    def _stream(self, identities: Bytes, slots: Bytes, tags: Bytes) -> Bytes:
        """[N, size or more] the key streams; `tags` [N, tag bytes or more]."""
        seeds = np.empty((len(identities), _BLOCK), np.uint8)
        kernels.seed(identities, slots, tags, self._tag, seeds)
        counted = np.empty((len(seeds), -(-self.size // _BLOCK), _BLOCK), np.uint8)
        kernels.count(_encrypt(self._seed_key, seeds), counted)
        return _encrypt(self._stream_key, counted).reshape(len(seeds), -1)


def _encrypt(key: bytes, blocks: Bytes) -> Bytes:
    """Every 16 bytes of `blocks` through AES-256: a permutation of blocks, not a mode of operation."""
    plain = np.ascontiguousarray(blocks)
    encrypted = np.empty(plain.size + _BLOCK - 1, np.uint8)  # the library wants room for one more block
    Cipher(AES(key), ECB()).encryptor().update_into(plain.reshape(-1).data, encrypted.data)
    return encrypted[: plain.size].reshape(blocks.shape)
