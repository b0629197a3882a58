"""A payload as bytes, for channels that carry nothing but these.

Framed, for what is compressed and encrypted as a whole: 15 bytes with the method's name, the data.
Packed, for channels where every byte counts: 1 byte (twice the length of the method's name, plus 1 if the
data are compressed), the name, the data, compressed where that makes them shorter.
"""

from __future__ import annotations

import zlib

from keyss.channels.base import METHOD_BYTES, Content, Payload, pack_method, unpack_method
from keyss.core.errors import InputError

_MAX_RATIO = 16  # of compression: what a reader spends memory on is bounded


def frame_payload(content: Content) -> bytes:
    """The method's name and the data. Raises TypeError for records."""
    if not isinstance(content, Payload):
        raise TypeError("expected a payload: this channel carries no records")
    return pack_method(content.method) + content.data


def unframe_payload(data: bytes) -> Payload:
    """What `frame_payload` framed. Raises ValueError for anything else."""
    return Payload(unpack_method(data), data[METHOD_BYTES:])


def pack_payload(content: Content) -> bytes:
    """The bytes of a payload. Raises TypeError for records."""
    framed = frame_payload(content)
    name, data = framed[:METHOD_BYTES].rstrip(b"\0"), framed[METHOD_BYTES:]
    packed = zlib.compress(data, 9)
    if len(packed) < len(data) <= _MAX_RATIO * len(packed):
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
            rest = unpacker.decompress(rest, _MAX_RATIO * len(rest))
        except zlib.error as error:
            raise InputError(f"the hidden data cannot be decompressed: {error}") from error
        if not unpacker.eof:
            raise InputError("the hidden data are damaged: they are not whole")
    return Payload(name.decode("ascii"), rest)
