"""A model as the page can read it: as it lies there, or converted where the page does not read its format."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

from keyss.core.errors import KeyssWarning

# What the page reads: by first bytes, or by the ends of names of formats that have no other sign.
_MAGIC, _NAMES = (b"ply", b"NGSP", b"\x1f\x8b", b"PK\x03\x04"), (".splat",)
_MAX_HEADER = 64 << 10  # bytes of a .ply


@dataclass(frozen=True)
class Shown:
    """A file for the page."""

    name: str  # of the formats that have no other sign, the page goes by its end
    open: Callable[[], BinaryIO]  # raises OSError
    bytes: int


def shown(model: Path) -> Shown:
    """The file of a model as the page reads it, which is not looked at further if it is that already.

    What else keyss reads, SOG in a folder and .ply in text, is converted without loss, with a KeyssWarning.
    Raises InputError for what is no model, or damaged where it is converted.
    """
    try:
        with model.open("rb") as file:
            header = file.read(_MAX_HEADER)
            size = file.seek(0, 2)
    except OSError:
        header, size = b"", 0  # what it is will be said
    if is_shown(model.name, header):
        return Shown(model.name, lambda: model.open("rb"), size)
    return _converted(model)


def is_shown(name: str, start: bytes) -> bool:
    """Whether a file of this name that begins so is one that the page reads, if it is not damaged."""
    if start.startswith(b"ply") and b"\nformat ascii" in start[:_MAX_HEADER].partition(b"end_header")[0]:
        return False
    return start.startswith(_MAGIC) or bool(start and name.lower().endswith(_NAMES))


def _converted(model: Path) -> Shown:
    from keyss.files.models import model_bytes, read_model  # torch with them, for which a page need not wait

    found = read_model(model)
    in_folder = model.name.lower() == "meta.json"
    name = f"{model.absolute().parent.name or 'model'}.sog" if in_folder else f"{model.stem}.ply"
    data = model_bytes(name, found)
    what = "a SOG in a folder" if in_folder else f"a {model.suffix}, or a .ply in text,"
    warnings.warn(
        f"{model}: the page does not read {what}, and shows it as {name}, which holds the same",
        KeyssWarning,
        stacklevel=4,
    )
    return Shown(name, lambda: BytesIO(data), len(data))
