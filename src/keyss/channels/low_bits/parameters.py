"""The parameters of a hidden secret, which tell how its records are read, and the ciphers of a header.

    version (1 byte), service (1), method (15, padded with zeros), first bytes of the salts (12), cells of a
    carrier (1), bytes of a record (2), bytes of the header (2); then the header

They lie in *parameter cells*: one part each, with its number, PARAMETER_COPIES times. Numbers are
little-endian. The header of records is the method's; that of a payload tells its bytes and its codewords.
"""

from __future__ import annotations

import struct
from collections import Counter
from dataclasses import dataclass

import numpy as np

from keyss.channels.base import pack_method, unpack_method
from keyss.channels.low_bits.cells import TAG_BYTES, CellCipher
from keyss.channels.low_bits.layout import (
    DATA_KEY_BYTES,
    MAX_CELLS,
    MAX_CHUNKS,
    MAX_CODEWORDS,
    NUMBER_BYTES,
    PARAMETER_COPIES,
    PREFIX_BYTES,
    SALTS,
)
from keyss.channels.reed_solomon import LOST, Codewords
from keyss.core.arrays import Bytes
from keyss.core.errors import InputError
from keyss.keys.derivation import DerivedKey

VERSION = 3
MAX_HEADER_BYTES = 4096
PAYLOAD, RECORDS = 1, 2  # services
_PREFIX = struct.Struct(f"<BB15s{SALTS}sBHH")
_PAYLOAD = struct.Struct("<IIHH")  # bytes of the encrypted payload, codewords, chunks of one, data chunks


def key_cipher(key: DerivedKey) -> CellCipher:
    """The cipher of cells that hold a data key."""
    return CellCipher(key.expand("low-bits/key", 32), "key", DATA_KEY_BYTES)


def parameter_cipher(data_key: bytes, width: int) -> CellCipher:
    """The cipher of numbered parts of the parameters."""
    return CellCipher(data_key, "parameters", width - TAG_BYTES)


@dataclass(frozen=True)
class Parameters:
    """The parameters of records of `record_bytes`; a carrier holds `cells` of them."""

    service: int
    method: str
    salts: bytes  # the first byte of each
    cells: int
    record_bytes: int
    header: bytes

    def parts(self, width: int) -> Bytes:
        """[P, width - TAG_BYTES] numbered parts, every one PARAMETER_COPIES times."""
        prefix = _PREFIX.pack(
            VERSION,
            self.service,
            pack_method(self.method),
            self.salts,
            self.cells,
            self.record_bytes,
            len(self.header),
        )
        packed, size = prefix + self.header, width - TAG_BYTES - 1
        count = -(-len(packed) // size)
        parts = np.frombuffer(packed.ljust(count * size, b"\0"), np.uint8).reshape(count, size)
        numbered = np.concatenate([np.arange(count, dtype=np.uint8)[:, None], parts], axis=1)
        return np.tile(numbered, (PARAMETER_COPIES, 1))


def unpack(parts: Bytes) -> Parameters:
    """From decrypted parts [P, 1 + part] in any order; of parts with one number the most frequent counts.

    Raises InputError when some are lost, and for damage.
    """
    votes: dict[int, Counter[bytes]] = {}
    for row in parts:
        votes.setdefault(int(row[0]), Counter())[row[1:].tobytes()] += 1
    best = {number: counter.most_common(1)[0][0] for number, counter in votes.items()}
    version, service, name, salts, cells, size, length = _PREFIX.unpack(_joined(best, PREFIX_BYTES))
    if version != VERSION:
        raise InputError(f"hidden secret of version {version}; this program reads version {VERSION}")
    if service not in (PAYLOAD, RECORDS) or not 1 <= cells <= MAX_CELLS or length > MAX_HEADER_BYTES:
        raise InputError(
            f"the hidden parameters are damaged: service {service}, {cells} cells of a carrier, {length} "
            "bytes of header"
        )
    try:
        method = unpack_method(name)
    except ValueError as error:
        raise InputError(f"the hidden parameters are damaged: {error}") from error
    return Parameters(
        service, method, salts, cells, size, _joined(best, PREFIX_BYTES + length)[PREFIX_BYTES:]
    )


def pack_codewords(size: int, codewords: Codewords) -> bytes:
    """The header of a payload of `size` encrypted bytes."""
    return _PAYLOAD.pack(size, codewords.count, codewords.n, codewords.k)


def unpack_codewords(header: bytes, record_bytes: int) -> tuple[int, Codewords]:
    """What `pack_codewords` packed. Raises InputError for impossible numbers."""
    try:
        size, count, n, k = _PAYLOAD.unpack(header)
        codewords = Codewords(count, n, k, record_bytes - NUMBER_BYTES)
        if codewords.chunks > MAX_CODEWORDS * MAX_CHUNKS or not 0 < size <= codewords.size:
            raise ValueError(f"{size} bytes in {codewords}")
    except (ValueError, struct.error) as error:
        raise InputError(f"the hidden parameters are damaged: {error}") from error
    return size, codewords


def _joined(parts: dict[int, bytes], length: int) -> bytes:
    """The first `length` bytes. Raises InputError if a part is missing."""
    data, number = b"", 0
    while len(data) < length:
        if number not in parts:
            raise InputError(LOST)
        data += parts[number]
        number += 1
    return data[:length]
