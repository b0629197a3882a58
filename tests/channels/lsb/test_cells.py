"""Cells of many Gaussians: what opens, what does not, and that no key stream comes twice."""

from __future__ import annotations

import numpy as np
import pytest
from cryptography.hazmat.primitives.ciphers import Cipher
from cryptography.hazmat.primitives.ciphers.algorithms import AES
from cryptography.hazmat.primitives.ciphers.modes import CBC, ECB

from keyss.channels import CellCipher
from keyss.channels.lsb.cells import TAG_BYTES
from keyss.keys.derivation import expand

RANDOM = np.random.default_rng(0)
SECRET = bytes(range(32))


def _bytes(*shape: int) -> np.ndarray:
    return RANDOM.integers(0, 256, shape, dtype=np.uint8)


@pytest.mark.parametrize("size", [1, 15, 16, 33, 71])
def test_round_trip_and_what_is_behind_a_cell_is_ignored(size: int) -> None:
    ids, data = _bytes(50, 16), _bytes(50, size)
    cipher = CellCipher(SECRET, "x", size)
    cells = cipher.encrypt(ids, data)
    fits, opened = cipher.decrypt(ids, np.concatenate([cells, _bytes(50, 3)], axis=1))
    assert fits.all()
    assert (opened == data).all()


def test_the_construction_is_the_documented_one() -> None:
    """Cell by cell, with the library's own CBC."""
    size = 40
    ids, data = _bytes(5, 16), _bytes(5, size)
    cells = CellCipher(SECRET, "x", size).encrypt(ids, data)
    for name, plain, cell in zip(ids, data, cells, strict=True):
        message = name.tobytes() + plain.tobytes().ljust(48, b"\0")
        tag = Cipher(AES(expand(SECRET, "x/tag", 32)), CBC(bytes(16))).encryptor().update(message)[-16:]
        assert cell[:TAG_BYTES].tobytes() == tag[:TAG_BYTES]
        nonce = bytes(a ^ b for a, b in zip(name, tag[:4].ljust(16, b"\0"), strict=True))
        seed = _aes("x/seed", nonce)
        stream = b"".join(_aes("x/stream", seed[:-1] + bytes([seed[-1] ^ block])) for block in range(3))
        assert cell[TAG_BYTES:].tobytes() == bytes(a ^ b for a, b in zip(plain, stream, strict=False))


def _aes(label: str, block: bytes) -> bytes:
    return Cipher(AES(expand(SECRET, label, 32)), ECB()).encryptor().update(block)


def test_other_keys_labels_and_gaussians_open_nothing() -> None:
    ids, data = _bytes(2000, 16), _bytes(2000, 20)
    cells = CellCipher(SECRET, "x", 20).encrypt(ids, data)
    assert not CellCipher(bytes(32), "x", 20).decrypt(ids, cells)[0].any()
    assert not CellCipher(SECRET, "y", 20).decrypt(ids, cells)[0].any()
    assert not CellCipher(SECRET, "x", 20).decrypt(ids[::-1], cells)[0].any()


def test_every_single_flipped_bit_is_noticed() -> None:
    ids, data = _bytes(1, 16), _bytes(1, 20)
    cipher = CellCipher(SECRET, "x", 20)
    bits = np.unpackbits(cipher.encrypt(ids, data)) ^ np.eye(8 * 24, dtype=np.uint8)
    fits, _ = cipher.decrypt(np.repeat(ids, len(bits), axis=0), np.packbits(bits, axis=1))
    assert not fits.any()


def test_no_key_stream_comes_twice() -> None:
    """Zeros encrypted: the same in many Gaussians, other data in the same Gaussian."""
    cipher, ids = CellCipher(SECRET, "x", 32), _bytes(1000, 16)
    zeros = np.zeros((1000, 32), np.uint8)
    streams = [cipher.encrypt(ids, zeros)[:, TAG_BYTES:]]
    other = zeros.copy()
    other[:, -1] = 1
    streams.append(cipher.encrypt(ids, other)[:, TAG_BYTES:] ^ other)
    halves = np.concatenate(streams).reshape(-1, 16)
    assert len(np.unique(halves, axis=0)) == len(halves)


def test_data_of_another_size_is_refused() -> None:
    with pytest.raises(ValueError, match="expected data of shape"):
        CellCipher(SECRET, "x", 20).encrypt(_bytes(3, 16), _bytes(3, 19))
