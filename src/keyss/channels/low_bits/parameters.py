"""The parameters of a hidden secret: how what its key decrypts is to be read.

    version (1 byte), service (1), method (15, padded with zeros), zeros (12), numbers of the service, zeros
    up to 40 bytes; then what the method adds

They lie in *parameter cells*: one part each, with its number, PARAMETER_COPIES times. Numbers are
little-endian.
"""

from __future__ import annotations

import struct
from collections import Counter
from dataclasses import dataclass

import numpy as np

from keyss.channels.base import Bytes, pack_method, unpack_method
from keyss.channels.low_bits.layout import MAX_CELLS, PARAMETER_COPIES, PREFIX_BYTES, Carriers
from keyss.channels.low_bits.spread import Spread
from keyss.core.errors import InputError

VERSION = 2
MAX_HEADER_BYTES = 4096
_PREFIX = struct.Struct("<BB15s12x")
_PAYLOAD = struct.Struct("<II2B")  # bytes of the encrypted payload, codewords, chunks of one, data chunks
_RECORDS = struct.Struct("<BHH")  # cells of a carrier, bytes of a record, bytes of the method's header
_PAYLOAD_SERVICE, _RECORD_SERVICE = 1, 2


@dataclass(frozen=True)
class PayloadParameters:
    """Of a payload of `size` encrypted bytes."""

    method: str
    size: int
    spread: Spread

    def pack(self) -> bytes:
        numbers = _PAYLOAD.pack(self.size, self.spread.blocks, self.spread.n, self.spread.k)
        return _prefix(_PAYLOAD_SERVICE, self.method, numbers)


@dataclass(frozen=True)
class RecordParameters:
    """Of records of `record_bytes`, `cells` of which divide a carrier."""

    method: str
    cells: int
    record_bytes: int
    header: bytes

    def pack(self) -> bytes:
        numbers = _RECORDS.pack(self.cells, self.record_bytes, len(self.header))
        return _prefix(_RECORD_SERVICE, self.method, numbers) + self.header


def parts_of(packed: bytes, width: int) -> Bytes:
    """[P, 1 + part] numbered parts of packed parameters, every one PARAMETER_COPIES times."""
    size = Carriers(0, width).part_bytes
    count = -(-len(packed) // size)
    parts = np.frombuffer(packed.ljust(count * size, b"\0"), np.uint8).reshape(count, size)
    numbered = np.concatenate([np.arange(count, dtype=np.uint8)[:, None], parts], axis=1)
    return np.tile(numbered, (PARAMETER_COPIES, 1))


def unpack(parts: Bytes, chunk_bytes: int) -> PayloadParameters | RecordParameters:
    """From decrypted parts [P, 1 + part] in any order; of parts with one number the most frequent counts.

    Raises InputError when some are lost, and for damage; every number is held to its bounds.
    """
    votes: dict[int, Counter[bytes]] = {}
    for row in parts:
        votes.setdefault(int(row[0]), Counter())[row[1:].tobytes()] += 1
    best = {number: counter.most_common(1)[0][0] for number, counter in votes.items()}
    prefix = _joined(best, PREFIX_BYTES)
    version, service, name = _PREFIX.unpack_from(prefix)
    if version != VERSION:
        raise InputError(f"hidden secret of version {version}; this program reads version {VERSION}")
    try:
        method = unpack_method(name)
        if service == _PAYLOAD_SERVICE:
            size, blocks, n, k = _PAYLOAD.unpack_from(prefix, _PREFIX.size)
            spread = Spread(blocks, n, k, chunk_bytes)
            if not 0 < size <= spread.capacity:
                raise ValueError(f"{size} bytes in {spread}")
            return PayloadParameters(method, size, spread)
        cells, record_bytes, length = _RECORDS.unpack_from(prefix, _PREFIX.size)
        if service != _RECORD_SERVICE or not 1 <= cells <= MAX_CELLS or length > MAX_HEADER_BYTES:
            raise ValueError(f"service {service}, {cells} cells of a carrier, {length} bytes of header")
    except ValueError as error:  # of decoding text too
        raise InputError(f"the hidden parameters are damaged: {error}") from error
    header = _joined(best, PREFIX_BYTES + length)[PREFIX_BYTES:]
    return RecordParameters(method, cells, record_bytes, header)


def _prefix(service: int, method: str, numbers: bytes) -> bytes:
    return (_PREFIX.pack(VERSION, service, pack_method(method)) + numbers).ljust(PREFIX_BYTES, b"\0")


def _joined(parts: dict[int, bytes], length: int) -> bytes:
    """The first `length` bytes. Raises InputError if a part is missing."""
    data, number = b"", 0
    while len(data) < length:
        if number not in parts:
            raise InputError("the key is right, but too much of the model was removed")
        data += parts[number]
        number += 1
    return data[:length]
