"""The layout of the last bits of all levels, in order of fields, Gaussians, and the lowest first.

    in a fixed random order, in blocks of ZONE_RATE bits: salt (16 bytes), slots (28 bytes each)
    the others, in an order that follows from the salt, in blocks of as many as a header says: data

What blocks hold is in `syndromes`. A *slot* is a header encrypted under what a key becomes with the salt, or
noise. The header says where the key's data begin, how long they are, and how much blocks hold. Data are a
range that may go on at the start; everything else is noise. The number of slots follows from the room. So
a key tells where its own data lie, and nothing else.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305

from keyss.channels.codes.fields import Field
from keyss.channels.codes.syndromes import BLOCK
from keyss.core.errors import InputError
from keyss.keys.derivation import SALT_BYTES, DerivedKey, stream

VERSION = 1
MIN_SLOTS, MAX_SLOTS = 4, 256
ZONE_RATE = 384  # bits that a block of salt and slots holds: more than half of its bits may have to stay
_MIN_SHARE, _SHARE = 1 / 4, 1 / 32  # of all bits that the least slots, and more of them, may take
_HEADER = struct.Struct("<BHIIx")  # version, bits that a block holds, first bit, bytes of data
SLOT_BYTES = _HEADER.size + 16
_ASSOCIATED = b"keyss/v1/codes"

Bits = npt.NDArray[np.uint8]  # each 0 or 1
Order = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Header:
    """What a slot tells."""

    rate: int  # bits that a block of data holds
    start: int  # of the data, in bits
    size: int  # bytes

    def encrypt(self, key: DerivedKey, slot: int) -> bytes:
        """SLOT_BYTES. Under a salt of its own a key encrypts one header and one content."""
        packed = _HEADER.pack(VERSION, self.rate, self.start, self.size)
        return _cipher(key).encrypt(_nonce(slot), packed, _ASSOCIATED)


@dataclass(frozen=True)
class Zones:
    """What fits into a number of bits."""

    bits: int

    @staticmethod
    def of(fields: list[Field]) -> Zones:
        return Zones(sum(each.room for each in fields))

    @property
    def slots(self) -> int:
        """A power of two; 0 where there is no room for what is needed at least."""
        if _zone_blocks(MIN_SLOTS) * BLOCK > self.bits * _MIN_SHARE:
            return 0
        found = MIN_SLOTS
        while found < MAX_SLOTS and _zone_blocks(2 * found) * BLOCK <= self.bits * _SHARE:
            found *= 2
        return found

    @property
    def zone_bits(self) -> int:
        """Bits in which salt and slots lie."""
        return _zone_blocks(self.slots) * BLOCK

    @property
    def data_blocks(self) -> int:
        return (self.bits - self.zone_bits) // BLOCK

    def zone_order(self) -> Order:
        """[bits] of which the first `zone_bits` are those of salt and slots, and the others those of data."""
        return order(bytes(SALT_BYTES), self.bits)


def _zone_blocks(slots: int) -> int:
    return -(-8 * (SALT_BYTES + slots * SLOT_BYTES) // ZONE_RATE)


def find_header(zone: bytes, key: DerivedKey, room: Zones) -> Header | None:
    """The header that `key` opens; all slots are tried. Raises InputError for one that makes no sense."""
    cipher, found = _cipher(key), None
    for slot in range(room.slots):
        start = SALT_BYTES + slot * SLOT_BYTES
        try:
            packed = cipher.decrypt(_nonce(slot), zone[start : start + SLOT_BYTES], _ASSOCIATED)
        except InvalidTag:
            continue
        found = found or packed
    if found is None:
        return None
    version, rate, first, size = _HEADER.unpack(found)
    if version != VERSION:
        raise InputError(f"hidden secret of version {version}; this program reads version {VERSION}")
    data_bits = room.data_blocks * rate
    if not (rate <= BLOCK and 0 < 8 * size <= data_bits and first < data_bits):
        raise InputError("the hidden parameters are damaged: they name more than there is")
    return Header(rate, first, size)


def order(salt: bytes, count: int) -> Order:
    """[count] the bits of data, in the order in which blocks take them."""
    numbers = np.frombuffer(stream(salt + bytes(16), "codes/order", 8 * count), "<u8")
    # Sorted with their numbers in the lower half: this is the same everywhere, and faster than `argsort`.
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
