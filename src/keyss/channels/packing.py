"""A payload as bytes, for channels that carry nothing but these: compressed where that makes it shorter.

1 byte: whether it is compressed (1) and twice the length of the method's name, the name, the data
"""

from __future__ import annotations

import zlib

from keyss.channels.base import METHOD_BYTES, Payload
from keyss.core.errors import InputError

_MOST_RATIO = 16  # of compression: what a reader spends memory on is bounded


def pack_payload(payload: Payload) -> bytes:
    """The bytes of a payload."""
    name, data = payload.method.encode("ascii"), payload.data
    if not 1 <= len(name) <= METHOD_BYTES:
        raise ValueError(f"expected the name of a method, 1 to {METHOD_BYTES} characters, got {name!r}")
    packed = zlib.compress(data, 9)
    if len(packed) < len(data) <= _MOST_RATIO * len(packed):
        return bytes([2 * len(name) + 1]) + name + packed
    return bytes([2 * len(name)]) + name + data


def unpack_payload(data: bytes) -> Payload:
    """What `pack_payload` packed. Raises InputError for anything else."""
    length, compressed = divmod(data[0] if data else 0, 2)
    name, rest = data[1 : 1 + length], data[1 + length :]
    if not (1 <= length <= METHOD_BYTES and len(name) == length and name.isascii()):
        raise InputError("the hidden data are damaged: they begin with no name of a method")
    if compressed:
        unpacker = zlib.decompressobj()
        try:
            rest = unpacker.decompress(rest, _MOST_RATIO * len(rest))
        except zlib.error as error:
            raise InputError(f"the hidden data cannot be decompressed: {error}") from error
        if not unpacker.eof:
            raise InputError("the hidden data are damaged: they are not whole")
    return Payload(name.decode("ascii"), rest)
