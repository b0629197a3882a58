"""Any file as a secret: bytes with a name, which come out whole or not at all."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field

from keyss.channels import Content, Payload
from keyss.core.errors import InputError, UsageError

NAME = "file"  # in the place of a method's
MAX_NAME_BYTES = 255

_LENGTH = struct.Struct("<B")


@dataclass(frozen=True)
class HiddenFile:
    """A file, by the name that it had; to be shown, never to be taken as a path."""

    name: str
    data: bytes = field(repr=False)

    def payload(self) -> Payload:
        """What a channel carries. Raises UsageError for a name of more than MAX_NAME_BYTES."""
        name = self.name.encode()
        if len(name) > MAX_NAME_BYTES:
            raise UsageError(f"expected a name of at most {MAX_NAME_BYTES} bytes, got {len(name)}")
        return Payload(NAME, _LENGTH.pack(len(name)) + name + self.data)

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


class OpensAFileError(InputError):
    """The key opens a hidden file where a scene was expected."""

    def __init__(self, file: HiddenFile) -> None:
        super().__init__(
            f"this key opens a file of {len(file.data):,} bytes, not a scene: give it a name that is not a "
            "model's"
        )
        self.file = file
