"""Packets: some bytes and their number, in words that look random without the key.

A word is the data, of 7 or 8 bytes, and a tag: the packet's number in all bits that are left, masked with the
AES-256 encryption of the data under the packets' key. Under the right key packets have the numbers that there
are, and other words hardly ever; the few that do are found by the code over all packets. The data of a secret
are encrypted before they come here.
"""

from __future__ import annotations

import numpy as np

from keyss.channels.appended.words import WORD_BITS, bits_of, number
from keyss.channels.mixing import encrypted_blocks
from keyss.core.arrays import Bits, Bytes, Words

HEADERS = 40  # copies of a header
HEADER_BITS = 20
_AGREEING_HEADERS = 12  # fewer may agree by chance among a million words


def write(key: bytes, numbers: Words, data: Bytes) -> Bits:
    """[N, WORD_BITS] words of packets with `numbers` [N] and `data` [N, width]; a key of 32 bytes."""
    tag_bits = WORD_BITS - 8 * data.shape[1]
    tags = bits_of(_masks(key, data, tag_bits) ^ numbers, tag_bits)
    return np.concatenate([np.unpackbits(data, axis=1), tags], axis=1)


def read(key: bytes, words: Bits, width: int) -> tuple[Words, Bytes]:
    """Numbers [N] and data [N, width] of words [N, WORD_BITS] as if all were packets."""
    data = np.packbits(words[:, : 8 * width], axis=1)
    tags = words[:, 8 * width :]
    return number(tags) ^ _masks(key, data, tags.shape[1]), data


def write_header(key: bytes, value: int, width: int, random: np.random.Generator) -> Bits:
    """[HEADERS, WORD_BITS] words that tell the holder of the key a number of HEADER_BITS."""
    data = random.integers(0, 256, (HEADERS, width), np.uint8)
    return write(key, np.full(HEADERS, value, np.uint64), data)


def read_header(key: bytes, words: Bits, width: int) -> int | None:
    """The number that most headers tell; None where there are too few."""
    numbers, _ = read(key, words, width)
    votes = np.bincount(numbers[numbers < 1 << HEADER_BITS].astype(np.int64), minlength=1)
    return int(votes.argmax()) if votes.max() >= _AGREEING_HEADERS else None


def _masks(key: bytes, data: Bytes, bits: int) -> Words:
    """[N] the masks of tags."""
    blocks = np.zeros((len(data), 16), np.uint8)
    blocks[:, : data.shape[1]] = data
    return encrypted_blocks(key, blocks).view(">u8")[:, 0].astype(np.uint64) >> np.uint64(64 - bits)
