"""Packets: 6 bytes and their number, in words that look random without the key.

A word is 48 bits of data and 36 bits of tag: a number of 20 bits and 16 bits of its hash, masked with the
AES-256 encryption of the data under the packets' key. The key tells which words are packets (one in 65,536
others passes), and their numbers. The data of a secret are encrypted before they come here.
"""

from __future__ import annotations

from collections import Counter

import numpy as np

from keyss.channels.appended.lattice import WORD_BITS, bits_of, number
from keyss.channels.mixing import encrypted_blocks, mixed
from keyss.core.arrays import Bits, Bytes, Words

PACKET_BYTES = 6
NUMBER_BITS = 20
HEADERS = 40  # copies of a header
_DATA_BITS = 8 * PACKET_BYTES
_CHECK_BITS = WORD_BITS - _DATA_BITS - NUMBER_BITS
_AGREEING_HEADERS = 3  # one or two may be there by chance


def write(key: bytes, numbers: Words, data: Bytes) -> Bits:
    """[N, WORD_BITS] words of packets with `numbers` [N] and `data` [N, PACKET_BYTES]; a key of 32 bytes."""
    tags = _masks(key, data) ^ (numbers << np.uint64(_CHECK_BITS) | _checks(numbers))
    return np.concatenate([np.unpackbits(data, axis=1), bits_of(tags, NUMBER_BITS + _CHECK_BITS)], axis=1)


def read(key: bytes, words: Bits) -> tuple[Words, Bytes]:
    """Numbers [P] and data [P, PACKET_BYTES] of the packets among words [N, WORD_BITS]."""
    data = np.packbits(words[:, :_DATA_BITS], axis=1)
    tags = number(words[:, _DATA_BITS:]) ^ _masks(key, data)
    numbers = tags >> np.uint64(_CHECK_BITS)
    own = tags & np.uint64((1 << _CHECK_BITS) - 1) == _checks(numbers)
    return numbers[own], data[own]


def write_header(key: bytes, value: int, random: np.random.Generator) -> Bits:
    """[HEADERS, WORD_BITS] words that tell the holder of the key a number of NUMBER_BITS."""
    data = random.integers(0, 256, (HEADERS, PACKET_BYTES), np.uint8)
    return write(key, np.full(HEADERS, value, np.uint64), data)


def read_header(key: bytes, words: Bits) -> int | None:
    """The number that most headers tell; None where there are too few."""
    votes = Counter(read(key, words)[0].tolist())
    value, count = votes.most_common(1)[0] if votes else (0, 0)
    return value if count >= _AGREEING_HEADERS else None


def _checks(numbers: Words) -> Words:
    """[N] the check bits of numbers."""
    return mixed(numbers) >> np.uint64(64 - _CHECK_BITS)


def _masks(key: bytes, data: Bytes) -> Words:
    """[N] the masks of tags."""
    blocks = np.zeros((len(data), 16), np.uint8)
    blocks[:, :PACKET_BYTES] = data
    shift = np.uint64(64 - NUMBER_BITS - _CHECK_BITS)
    return encrypted_blocks(key, blocks).view(">u8")[:, 0].astype(np.uint64) >> shift
