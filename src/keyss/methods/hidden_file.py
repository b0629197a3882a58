"""Any file as a secret: bytes with a name, which come out whole or not at all.

It lies in low bits, or in the robust channel, which survives formats that round and is read by nobody else.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass, field

from keyss.channels.base import Content, Payload
from keyss.core.errors import InputError, UsageError

NAME = "file"  # in the place of a method's
MOST_NAME_BYTES = 255

_MOST_RATIO = 16  # of compression: what a reader spends memory on is bounded
_LENGTH = struct.Struct("<B")


@dataclass(frozen=True)
class HiddenFile:
    """A file, by the name that it had; to be shown, never to be taken as a path."""

    name: str
    data: bytes = field(repr=False)

    def payload(self) -> Payload:
        """What a channel carries. Raises UsageError for a name of more than MOST_NAME_BYTES."""
        name = self.name.encode()
        if len(name) > MOST_NAME_BYTES:
            raise UsageError(f"expected a name of at most {MOST_NAME_BYTES} bytes, got {len(name)}")
        return Payload(NAME, _LENGTH.pack(len(name)) + name + self.data)

    def packed(self) -> bytes:
        """The same for a channel that does not compress."""
        data = self.payload().data
        packed = zlib.compress(data, 9)
        return b"\1" + packed if len(packed) < len(data) <= _MOST_RATIO * len(packed) else b"\0" + data

    @staticmethod
    def unpacked(data: bytes) -> HiddenFile:
        """What `packed` gave. Raises InputError for damage."""
        if data[:1] == b"\1":
            unpacker = zlib.decompressobj()
            try:
                payload = unpacker.decompress(data[1:], _MOST_RATIO * len(data))
            except zlib.error as error:
                raise InputError(f"the hidden file cannot be decompressed: {error}") from error
            if not unpacker.eof:
                raise InputError("the hidden file is damaged: it is not whole")
        else:
            payload = data[1:]
        return HiddenFile.of(Payload(NAME, payload))

    @staticmethod
    def of(content: Content) -> HiddenFile:
        """What `payload` gave. Raises InputError for something else that a key opened, and for damage."""
        if content.method != NAME or not isinstance(content, Payload):
            raise InputError("this key opens a scene, not a file")
        size = content.data[0] if content.data else 0
        name, data = content.data[1 : 1 + size], content.data[1 + size :]
        if not content.data or len(name) < size:
            raise InputError("the hidden file is damaged: its name is cut off")
        return HiddenFile(name.decode(errors="replace"), data)
