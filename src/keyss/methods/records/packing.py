"""Codes of a few bits as bytes, one record after the other, and back."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import numpy.typing as npt

Codes = npt.NDArray[np.uint32]
Bytes = npt.NDArray[np.uint8]

CHUNK = 1 << 14  # Gaussians at a time: every bit takes a byte meanwhile


def packed(columns: Iterator[tuple[Codes, int]]) -> Bytes:
    """[N, bytes] the codes one after the other, the highest bit of each first."""
    parts = []
    for codes, bits in columns:
        shifts = np.arange(bits - 1, -1, -1, dtype=np.uint32)
        parts.append((codes[:, :, None] >> shifts & 1).astype(np.uint8).reshape(len(codes), -1))
    return np.packbits(np.concatenate(parts, axis=1), axis=1)


def records_of_codes(columns: Sequence[Codes], layout: Sequence[tuple[int, int]]) -> Bytes:
    """[N, bytes] records of codes [N, columns] for each (columns, bits) of a `layout`."""
    return packed(iter([(codes, bits) for codes, (_, bits) in zip(columns, layout, strict=True)]))


def codes_of_records(records: Bytes, layout: Sequence[tuple[int, int]]) -> list[Codes]:
    """The inverse of `records_of_codes`."""
    ends = np.cumsum([columns * bits for columns, bits in layout])
    found = [np.zeros((len(records), columns), np.uint32) for columns, _ in layout]
    for start in range(0, len(records), CHUNK):
        part = np.split(np.unpackbits(records[start : start + CHUNK], axis=1), ends, axis=1)
        for codes, unread, (columns, bits) in zip(found, part, layout, strict=False):
            powers = np.uint32(1) << np.arange(bits, dtype=np.uint32)[::-1]
            codes[start : start + CHUNK] = unread.reshape(-1, columns, bits) @ powers
    return found
