"""Where what lies: bits of the usable levels, in order of fields, Gaussians, columns, lowest bit first.

    of the first field: salt (16 bytes), slots (28 bytes each)
    of the rest of it and of the other fields: data, in an order that follows from the salt

A *slot* is a header encrypted under what a key becomes with the salt, or noise. The header says where in that
order the key's data begin, how long they are, and which fields take part. Data are a range that may go on
at the start of the order where it ends; all that is no data is noise. The number of slots follows from the
room. So all that a key tells is where its own data lie.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305

from keyss.channels.codes.fields import Field
from keyss.core.errors import InputError
from keyss.keys.derivation import SALT_BYTES, DerivedKey, stream

VERSION = 1
LEAST_SLOTS, MOST_SLOTS = 4, 256
_SLOT_SHARE = 1 / 8  # of the first field's room that slots may take
_HEADER = struct.Struct("<BHIIx")  # version, fields, first bit, bytes of data
SLOT_BYTES = _HEADER.size + 16
_ASSOCIATED = b"keyss/v1/codes"

Bits = npt.NDArray[np.uint8]  # each 0 or 1
Order = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Header:
    """What a slot tells."""

    fields: int  # bit i: field i carries data
    start: int  # of the data, in their order
    size: int  # bytes

    def encrypt(self, key: DerivedKey, slot: int) -> bytes:
        """SLOT_BYTES. Under a salt of its own a key encrypts one header and one content."""
        packed = _HEADER.pack(VERSION, self.fields, self.start, self.size)
        return _cipher(key).encrypt(_nonce(slot), packed, _ASSOCIATED)


@dataclass(frozen=True)
class Room:
    """What fits into fields of which the first is the head."""

    counts: tuple[int, ...]  # usable bits of each field

    @staticmethod
    def of(fields: list[Field]) -> Room:
        return Room(tuple(each.room for each in fields))

    @property
    def slots(self) -> int:
        """A power of two; 0 where there is no room for what is needed at least."""
        most = int(self.counts[0] * _SLOT_SHARE) // (8 * SLOT_BYTES)
        if most < LEAST_SLOTS:
            return 0
        return min(MOST_SLOTS, 1 << (most.bit_length() - 1))

    @property
    def zone_bits(self) -> int:
        """Bits of salt and slots: those of 1, 2 or 4 bits a level are whole levels."""
        return 8 * (SALT_BYTES + self.slots * SLOT_BYTES)

    def data_bits(self, fields: int) -> int:
        """Bits of data if only `fields` carry them."""
        counts = [self.counts[0] - self.zone_bits, *self.counts[1:]]
        return sum(count for index, count in enumerate(counts) if fields >> index & 1)


def find_header(zone: bytes, key: DerivedKey, room: Room) -> Header | None:
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
    version, fields, first, size = _HEADER.unpack(found)
    if version != VERSION:
        raise InputError(f"hidden secret of version {version}; this program reads version {VERSION}")
    data_bits = room.data_bits(fields)
    if not (fields >> len(room.counts) == 0 and 0 < 8 * size <= data_bits and first < data_bits):
        raise InputError("the hidden parameters are damaged: they name more than there is")
    return Header(fields, first, size)


def order(salt: bytes, count: int) -> Order:
    """[count] the bits of data, in the order in which they are used."""
    numbers = np.frombuffer(stream(salt + bytes(16), "codes/order", 8 * count), "<u8")
    return np.argsort(numbers, kind="stable")


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
