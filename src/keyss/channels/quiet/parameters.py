"""The header of a hidden secret: cells with its data key, and cells with the parameters to read the rest.

    version (1 byte), service (1), method (15, padded with zeros), cells of a carrier (1), bytes of a record
    (2), bytes of the method's own header (2), Gaussians of the model (4), records (4); in low bits a sketch
    of these Gaussians (32, see `sketch`); then that header

Parameters are cut into numbered parts, one in each cell. Numbers are little-endian.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from itertools import takewhile

import numpy as np

from keyss.channels.base import METHOD_BYTES, pack_method, unpack_method
from keyss.channels.quiet.cells import TAG_BYTES, CellCipher
from keyss.channels.quiet.layout import (
    DATA_KEY_BYTES,
    MAX_CELLS,
    MAX_CHUNKS,
    MAX_CODEWORDS,
    NUMBER_BYTES,
    PREFIX_BYTES,
)
from keyss.channels.reed_solomon import LOST, Codewords
from keyss.channels.sketch import SKETCH_BYTES
from keyss.core.arrays import Bytes
from keyss.core.errors import InputError
from keyss.keys.derivation import DerivedKey

VERSION = 5
MAX_HEADER_BYTES = 4096
PAYLOAD, RECORDS = 1, 2  # services
_PAYLOAD = struct.Struct("<IIHH")  # bytes of the encrypted payload, codewords, chunks of one, data chunks
_PREFIX = struct.Struct(f"<BB{METHOD_BYTES}sBHHII")


def key_cipher(key: DerivedKey) -> CellCipher:
    """The cipher of cells that hold a data key."""
    return CellCipher(key.expand("quiet/key", 32), "key", DATA_KEY_BYTES)


def parameter_cipher(data_key: bytes, width: int) -> CellCipher:
    """The cipher of numbered parts of the parameters, in carriers of `width` bytes."""
    return CellCipher(data_key, "parameters", width - TAG_BYTES)


@dataclass(frozen=True)
class Parameters:
    """Parameters of a secret: `count` records and copies of `record_bytes`, `cells` per carrier."""

    service: int
    method: str
    cells: int
    record_bytes: int
    gaussians: int  # size of the published model
    count: int
    header: bytes
    sketch: bytes = b""  # empty in blocks

    def parts(self, width: int) -> Bytes:
        """[P, width - TAG_BYTES] numbered parts."""
        numbers = self.cells, self.record_bytes, len(self.header), self.gaussians, self.count
        packed = (
            _PREFIX.pack(VERSION, self.service, pack_method(self.method), *numbers)
            + self.sketch
            + self.header
        )
        size = width - TAG_BYTES - 1
        count = -(-len(packed) // size)
        parts = np.frombuffer(packed.ljust(count * size, b"\0"), np.uint8).reshape(count, size)
        return np.concatenate([np.arange(count, dtype=np.uint8)[:, None], parts], axis=1)


def unpack(parts: Bytes, sketch_bytes: int = SKETCH_BYTES) -> Parameters:
    """Parameters from decrypted parts [P, 1 + part] in any order. Raises InputError for damage or loss.

    `sketch_bytes`: 0 in blocks.
    """
    numbered = {int(row[0]): row[1:].tobytes() for row in parts}
    packed = b"".join(numbered[each] for each in takewhile(numbered.__contains__, range(len(numbered))))
    if len(packed) < PREFIX_BYTES:
        raise InputError(LOST)
    version, service, name, cells, size, length, gaussians, count = _PREFIX.unpack_from(packed)
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
    header, end = PREFIX_BYTES + sketch_bytes, PREFIX_BYTES + sketch_bytes + length
    if len(packed) < end:
        raise InputError(LOST)
    own, sketch = packed[header:end], packed[PREFIX_BYTES:header]
    return Parameters(service, method, cells, size, gaussians, count, own, sketch)


def pack_codewords(size: int, codewords: Codewords) -> bytes:
    """The header of a payload of `size` encrypted bytes in low bits."""
    return _PAYLOAD.pack(size, codewords.count, codewords.n, codewords.k)


def unpack_codewords(header: bytes, record_bytes: int) -> tuple[int, Codewords]:
    """Invert `pack_codewords`. Raises InputError for impossible numbers."""
    try:
        size, count, n, k = _PAYLOAD.unpack(header)
        codewords = Codewords(count, n, k, record_bytes - NUMBER_BYTES)
        if codewords.chunks > MAX_CODEWORDS * MAX_CHUNKS or not 0 < size <= codewords.size:
            raise ValueError(f"{size} bytes in {codewords}")
    except (ValueError, struct.error) as error:
        raise InputError(f"the hidden parameters are damaged: {error}") from error
    return size, codewords
