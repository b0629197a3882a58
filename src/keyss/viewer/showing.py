"""Models in a format that the page reads, converted if necessary."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

from keyss.core.errors import KeyssWarning

# The page recognises formats by their first bytes, and .splat, which has no signature, by its name.
_MAGIC = (b"ply", b"NGSP", b"\x1f\x8b", b"PK\x03\x04")
_MAX_HEADER = 64 << 10  # bytes of a .ply


@dataclass(frozen=True)
class Readable:
    """A model file for the page."""

    name: str
    open: Callable[[], BinaryIO]  # raises OSError
    size: int  # bytes


def readable(model: Path) -> Readable:
    """The model's file if the page reads its format, else a lossless conversion, with a KeyssWarning.

    Only a file that is converted is parsed here. Raises InputError if it is not a valid model.
    """
    try:
        with model.open("rb") as file:
            header = file.read(_MAX_HEADER)
            size = file.seek(0, 2)
    except OSError:
        header, size = b"", 0  # read_model raises the InputError
    if _is_readable(model.name, header):
        return Readable(model.name, lambda: model.open("rb"), size)

    from keyss.files import read_model  # imports torch, which the page itself does not need
    from keyss.files.models import model_bytes

    gaussians = read_model(model)
    name, kind = f"{model.stem}.ply", f"a {model.suffix}"
    if header.startswith(b"ply"):
        kind = "a .ply in text"
    data = model_bytes(name, gaussians)
    warnings.warn(
        f"{model}: the page does not read {kind}; it shows a lossless copy, {name}",
        KeyssWarning,
        stacklevel=3,
    )
    return Readable(name, lambda: BytesIO(data), len(data))


def _is_readable(name: str, start: bytes) -> bool:
    """True if the page reads the format of a file with this name and these first bytes."""
    if start.startswith(b"ply"):
        return b"\nformat ascii" not in start[:_MAX_HEADER].partition(b"end_header")[0]
    return start.startswith(_MAGIC) or bool(start and name.lower().endswith(".splat"))
