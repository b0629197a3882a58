"""The layout of the last bits of all levels, in order of fields, Gaussians, and the lowest first.

    in a fixed random order, in blocks of ZONE_RATE bits: salt (16 bytes), slots (28 bytes each)
    the others, in an order that the salt determines, in blocks of as many bits as a header says: data

How blocks hold bits is in `syndromes`. A *slot* is a header encrypted under the key and the salt, or noise.
The header tells where the key's data begin, their length, and how many bits a block holds. Data are a range
that may wrap around; everything else is noise. The number of slots follows from the room. So a key reveals
where its own data are, and nothing else.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305

from keyss.channels.codes.syndromes import BLOCK
from keyss.core.arrays import Bits, Integers
from keyss.core.errors import InputError
from keyss.keys.derivation import SALT_BYTES, DerivedKey, stream

VERSION = 1
MIN_SLOTS, MAX_SLOTS = 4, 256
ZONE_RATE = 384  # bits that a block of salt and slots holds: more than half of its bits may have to stay
_MIN_SHARE, _SHARE = 1 / 4, 1 / 32  # of all bits: for MIN_SLOTS, for more slots
_HEADER = struct.Struct("<BHIIx")  # version, bits that a block holds, first bit, bytes of data
SLOT_BYTES = _HEADER.size + 16
_ASSOCIATED = b"keyss/v1/codes"


@dataclass(frozen=True)
class Header:
    """The content of a slot."""

    rate: int  # bits that a block of data holds
    start: int  # of the data, in bits
    size: int  # bytes

    def encrypt(self, key: DerivedKey, slot: int) -> bytes:
        """SLOT_BYTES. Under a salt of its own a key encrypts one header and one content."""
        packed = _HEADER.pack(VERSION, self.rate, self.start, self.size)
        return _cipher(key).encrypt(_nonce(slot), packed, _ASSOCIATED)


@dataclass(frozen=True)
class Zones:
    """How a number of bits is divided."""

    bits: int

    @property
    def slots(self) -> int:
        """A power of two; 0 where there is too little room for MIN_SLOTS."""
        if _zone_blocks(MIN_SLOTS) * BLOCK > self.bits * _MIN_SHARE:
            return 0
        slots = MIN_SLOTS
        while slots < MAX_SLOTS and _zone_blocks(2 * slots) * BLOCK <= self.bits * _SHARE:
            slots *= 2
        return slots

    @property
    def zone_bits(self) -> int:
        """Bits for salt and slots."""
        return _zone_blocks(self.slots) * BLOCK

    @property
    def data_blocks(self) -> int:
        return (self.bits - self.zone_bits) // BLOCK

    def zone_places(self) -> tuple[Integers, Integers]:
        """The bits of salt and slots, and all others."""
        zone, others = np.split(_order(bytes(SALT_BYTES), self.bits), [self.zone_bits])
        return zone, others

    def places(self, salt: bytes) -> tuple[Integers, Integers]:
        """The bits of salt and slots, and those of data, in the order in which blocks take them."""
        zone, others = self.zone_places()
        return zone, others[_order(salt, len(others))][: self.data_blocks * BLOCK]


def _zone_blocks(slots: int) -> int:
    return -(-8 * (SALT_BYTES + slots * SLOT_BYTES) // ZONE_RATE)


def find_header(zone: bytes, key: DerivedKey, room: Zones) -> Header | None:
    """The header that `key` opens; all slots are tried. Raises InputError for an impossible one."""
    cipher, packed = _cipher(key), None
    for slot in range(room.slots):
        start = SALT_BYTES + slot * SLOT_BYTES
        try:
            opened = cipher.decrypt(_nonce(slot), zone[start : start + SLOT_BYTES], _ASSOCIATED)
        except InvalidTag:
            continue
        packed = packed or opened
    if packed is None:
        return None
    version, rate, first, size = _HEADER.unpack(packed)
    if version != VERSION:
        raise InputError(f"hidden secret of version {version}; this program reads version {VERSION}")
    data_bits = room.data_blocks * rate
    if not (rate <= BLOCK and 0 < 8 * size <= data_bits and first < data_bits):
        raise InputError("the hidden parameters are damaged: the data they describe exceed the file")
    return Header(rate, first, size)


def _order(salt: bytes, count: int) -> Integers:
    """[count] a random order that `salt` determines."""
    numbers = np.frombuffer(stream(salt + bytes(16), "codes/order", 8 * count), "<u8")
    # Sorted with their numbers in the lower half: the same on all machines, and faster than `argsort`.
    lower = np.uint64(2**32 - 1)
    return (np.sort(numbers & ~lower | np.arange(count, dtype=np.uint64)) & lower).astype(np.int64)


def to_bits(data: bytes) -> Bits:
    """[8 B] the bits of bytes, the lowest first."""
    return np.unpackbits(np.frombuffer(data, np.uint8), bitorder="little")


def to_bytes(bits: Bits) -> bytes:
    """The inverse of `to_bits`."""
    return np.packbits(bits, bitorder="little").tobytes()


def _cipher(key: DerivedKey) -> ChaCha20Poly1305:
    return ChaCha20Poly1305(key.expand("codes/header", 32))


def _nonce(slot: int) -> bytes:
    return slot.to_bytes(12, "little")
