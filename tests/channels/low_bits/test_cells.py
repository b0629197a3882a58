"""Cells: their own key and Gaussian open them, nothing else does, and no key stream comes twice."""

from __future__ import annotations

import os

from keyss.channels.low_bits.byte_cells import OVERHEAD, TAG_BYTES, CellCipher

CIPHER = CellCipher(bytes(32), "data")
IDENTITY = bytes(range(16))


def test_round_trip_of_every_size() -> None:
    for size in range(1, 140):
        data = os.urandom(size)
        cell = CIPHER.close(IDENTITY, 0xABCDEF, data)
        assert len(cell) == size + OVERHEAD
        assert CIPHER.open(IDENTITY, cell) == (0xABCDEF, data)


def test_other_keys_labels_gaussians_and_changes_do_not_open() -> None:
    cell = CIPHER.close(IDENTITY, 5, b"some data")
    assert CellCipher(bytes(31) + b"\1", "data").open(IDENTITY, cell) is None
    assert CellCipher(bytes(32), "header").open(IDENTITY, cell) is None
    assert CIPHER.open(bytes(16), cell) is None
    for position in range(len(cell)):
        for bit in range(8):
            changed = bytearray(cell)
            changed[position] ^= 1 << bit
            assert CIPHER.open(IDENTITY, bytes(changed)) is None


def test_other_data_in_the_same_gaussian_get_another_key_stream() -> None:
    cells = [CIPHER.close(IDENTITY, 5, bytes([value]) * 40) for value in (0, 1)]
    streams = [
        bytes(a ^ b for a, b in zip(cell[TAG_BYTES + 3 :], bytes([value]) * 40, strict=True))
        for value, cell in enumerate(cells)
    ]
    assert sum(a == b for a, b in zip(*streams, strict=True)) < 8
