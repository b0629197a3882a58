"""Typed records in JSON files: frozen dataclasses, read and written by msgspec.

A file's record has an integer field `version`. Its default is the version that this program writes and reads.
Unknown fields are ignored; all others must have the declared types.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from keyss.core.errors import InputError
from keyss.files.atomic import write_bytes
from keyss.files.inputs import as_text, read_file

MAX_BYTES = 16 * 2**20

T = TypeVar("T")


class _Versioned(msgspec.Struct):
    version: int


def read_record(path: Path, type: type[T]) -> T:
    """Read the record of a dataclass from a JSON file of at most MAX_BYTES.

    Raises InputError, with the file and the place in it, if the file is missing, too large or not JSON, has
    another version, or has values of wrong types.
    """
    data = read_file(path, MAX_BYTES)
    generic: Any = type
    expected = int(generic.version)  # a field's default is an attribute of its class
    try:
        version = msgspec.json.decode(data, type=_Versioned).version
        if version != expected:
            raise InputError(
                f"{path}: expected version {expected}, got {version}; "
                "make it again with this version of keyss, or read it with the one that wrote it"
            )
        return msgspec.json.decode(data, type=type)
    except (msgspec.MsgspecError, RecursionError, UnicodeError) as error:
        raise InputError(f"{path}: expected a record of keyss, version {expected}: {error}") from error


def write_record(path: Path, record: Any) -> None:
    """Write the JSON of a dataclass, atomically. Raises OutputError."""
    write_bytes(path, record_bytes(record))


def record_bytes(record: Any) -> bytes:
    """JSON of a dataclass, indented; NaN and infinite numbers become null.

    File names that are not text in this locale are decoded as UTF-8, and other bytes become U+FFFD.
    """
    try:
        data = msgspec.json.encode(record)
    except UnicodeEncodeError:
        text = as_text(json.dumps(msgspec.to_builtins(record), ensure_ascii=False))
        data = msgspec.json.encode(json.loads(text, parse_constant=lambda _: None))
    return msgspec.json.format(data, indent=2) + b"\n"
