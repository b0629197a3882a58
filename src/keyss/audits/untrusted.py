"""Untrusted content of an audit: its texts, its images, and the size of everything."""

from __future__ import annotations

from base64 import b64encode
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path

from keyss.audits.record import AUDIT_FOLDER
from keyss.core.errors import InputError
from keyss.files.images import probe_image
from keyss.files.reading import read_file

_MAX_PICTURE = 32 * 2**20
_MAX_PICTURES = 256 * 2**20  # of all together, for browsers
_MAX_ENTRIES = 10_000
_MAX_NUMBER = 1e15
_MAX_TEXT = 1_000
_PNG = b"\x89PNG\r\n\x1a\n"


def check_bounds(value: object, place: str = "audit") -> None:
    """Raise InputError for a list of more than 10,000 entries or a number beyond 1e15 in a record."""
    entries: dict[object, object] = {}
    if is_dataclass(value):
        entries = {f".{each.name}": getattr(value, each.name) for each in fields(value)}
    elif isinstance(value, dict):
        entries = {f".{clean(str(name))}": item for name, item in value.items()}
    elif isinstance(value, list | tuple):
        entries = {f"[{index}]": item for index, item in enumerate(value)}
    elif isinstance(value, int | float) and abs(value) > _MAX_NUMBER:
        raise InputError(f"{place}: expected a number of at most {_MAX_NUMBER:g} in size")
    if len(entries) > _MAX_ENTRIES:
        raise InputError(f"{place}: expected at most {_MAX_ENTRIES:,} entries, found {len(entries):,}")
    for name, item in entries.items():
        check_bounds(item, f"{place}{name}")


def clean(text: str) -> str:
    """One line of at most 1,000 printable characters: no control or bidirectional characters."""
    text = text[: _MAX_TEXT - 1] + "…" if len(text) > _MAX_TEXT else text
    return "".join(
        c if c.isprintable() else " " if c.isspace() else "\N{REPLACEMENT CHARACTER}" for c in text
    )


@dataclass(frozen=True)
class EmbeddedPicture:
    """A picture inside a page."""

    width: int  # pixels
    height: int
    url: str  # data:


class AuditPictures:
    """The pictures of an audit: PNG files in its folder."""

    def __init__(self, run: Path) -> None:
        self._folder = run / AUDIT_FOLDER
        self._left = _MAX_PICTURES

    def read(self, name: str) -> EmbeddedPicture:
        """Read a picture that the audit names.

        Raises InputError if it is outside the audit's folder, missing, not a PNG or too large.
        """
        try:
            folder = self._folder.resolve()
            path = (folder / name).resolve()
        except (OSError, RuntimeError, ValueError) as error:  # loops of links, invalid names
            raise InputError(f"expected the name of a picture, found {name!r}") from error
        if not path.is_relative_to(folder):
            raise InputError(f"expected a picture in {self._folder}, found {name!r}")
        data = read_file(path, min(_MAX_PICTURE, self._left))
        if not data.startswith(_PNG):
            raise InputError(f"{path}: expected a PNG picture")
        width, height, _ = probe_image(path)
        self._left -= len(data)
        return EmbeddedPicture(width, height, "data:image/png;base64," + b64encode(data).decode())
