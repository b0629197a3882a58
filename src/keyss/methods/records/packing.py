"""Codes of a few bits as bytes, one record after the other, and back."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

Codes = npt.NDArray[np.uint32]
Bytes = npt.NDArray[np.uint8]

CHUNK = 1 << 14  # Gaussians at a time: every bit takes a byte meanwhile


def records_of_codes(columns: Sequence[Codes], layout: Sequence[tuple[int, int]]) -> Bytes:
    """[N, bytes] the codes one after the other, the highest bit of each first.

    `columns`: codes [N, columns] for each (columns, bits) of `layout`.
    """
    parts = []
    for start in range(0, len(columns[0]), CHUNK):
        bits = []
        for codes, (_, count) in zip(columns, layout, strict=True):
            shifts = np.arange(count - 1, -1, -1, dtype=np.uint32)
            part = codes[start : start + CHUNK, :, None] >> shifts & 1
            bits.append(part.astype(np.uint8).reshape(len(part), -1))
        parts.append(np.packbits(np.concatenate(bits, axis=1), axis=1))
    return np.concatenate(parts)


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
