"""Packets: a few bytes and a packet number, in words that look random without the key.

A word is 6 or 8 bytes of data and a tag. The tag fills the word: it is the packet number, masked with the
AES-256 encryption of the data. Under the right key, packets have valid numbers and other words rarely do;
Reed-Solomon corrects the few that do. Data are encrypted before they get here.
"""

from __future__ import annotations

import numpy as np

from keyss.channels.appended.words import WORD_BITS, bits_of, number
from keyss.channels.mixing import encrypted_blocks
from keyss.core.arrays import Bits, Bytes, Words

HEADERS = 40  # copies of a header
HEADER_BITS = 20
_MIN_VOTES = 12  # fewer can agree by chance among a million words


def write(key: bytes, numbers: Words, data: Bytes) -> Bits:
    """Words [N, WORD_BITS] of packets with `numbers` [N] and `data` [N, width]; `key`: 32 bytes."""
    tag_bits = WORD_BITS - 8 * data.shape[1]
    tags = bits_of(_masks(key, data, tag_bits) ^ numbers, tag_bits)
    return np.concatenate([np.unpackbits(data, axis=1), tags], axis=1)


def read(key: bytes, words: Bits, width: int) -> tuple[Words, Bytes]:
    """Numbers [N] and data [N, width] of words [N, WORD_BITS], as if all were packets."""
    data = np.packbits(words[:, : 8 * width], axis=1)
    tags = words[:, 8 * width :]
    return number(tags) ^ _masks(key, data, tags.shape[1]), data


def write_header(key: bytes, value: int, width: int, random: np.random.Generator) -> Bits:
    """Words [HEADERS, WORD_BITS] that all hold `value`, a number of HEADER_BITS."""
    data = random.integers(0, 256, (HEADERS, width), np.uint8)
    return write(key, np.full(HEADERS, value, np.uint64), data)


def read_header(key: bytes, words: Bits, width: int) -> int | None:
    """The value of the headers by majority; None if too few agree."""
    numbers, _ = read(key, words, width)
    votes = np.bincount(numbers[numbers < 1 << HEADER_BITS].astype(np.int64), minlength=1)
    return int(votes.argmax()) if votes.max() >= _MIN_VOTES else None


def _masks(key: bytes, data: Bytes, bits: int) -> Words:
    """Masks [N] of tags."""
    blocks = np.zeros((len(data), 16), np.uint8)
    blocks[:, : data.shape[1]] = data
    return encrypted_blocks(key, blocks).view(">u8")[:, 0].astype(np.uint64) >> np.uint64(64 - bits)
