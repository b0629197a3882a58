"""An audit from disk: bounded, and of the types that the report expects, whoever made it.

Every section of an audit may be missing, and unknown ones are passed over. What is there and is not what it
should be (a text for a number, a picture outside the audit's folder) is an InputError that names its place.
"""

from __future__ import annotations

import json
import math
from base64 import b64encode
from dataclasses import dataclass
from pathlib import Path

from keyss.core.errors import InputError
from keyss.files.images import probe_image
from keyss.files.reading import read_file

AUDIT = "audit"  # folder in a run's folder
VERSION = 1

_MAX_BYTES = 16 * 2**20
_MAX_PICTURE = 32 * 2**20
_MAX_PICTURES = 256 * 2**20  # of all together: what a browser still opens
_MAX_ENTRIES = 10_000
_MAX_NUMBER = 1e15
_MAX_TEXT = 1_000
_MAX_DEPTH = 10
_PNG = b"\x89PNG\r\n\x1a\n"


@dataclass(frozen=True)
class Part:
    """An object of an audit. What is missing or null reads as empty, another type is an InputError."""

    place: str
    entries: dict[str, object]

    def __bool__(self) -> bool:
        return bool(self.entries)

    def part(self, key: str) -> Part:
        """The object under `key`."""
        return _part(self._at(key), self.entries.get(key))

    def parts(self, key: str, at_most: int = _MAX_ENTRIES) -> list[Part]:
        """The list of objects under `key`."""
        return [_part(place, value) for place, value in self._items(key, at_most)]

    def lists(self, key: str, at_most: int) -> list[list[Part]]:
        """The list of lists of objects under `key`."""
        rows = [Part(place, {"": value}) for place, value in self._items(key, at_most)]
        return [row.parts("", at_most) for row in rows]

    def named(self, key: str, at_most: int = _MAX_ENTRIES) -> dict[str, Part]:
        """The objects in the object under `key`, by their names."""
        whole = self.part(key)
        _check_count(whole.place, len(whole.entries), at_most)
        return {clean(name): _part(whole._at(name), value) for name, value in whole.entries.items()}

    def text(self, key: str) -> str:
        """The text under `key`, printable; "" if there is none. Long ones are cut."""
        value = self.entries.get(key)
        if value is None:
            return ""
        if not isinstance(value, str):
            raise _unexpected(self._at(key), "a text", value)
        return clean(value)

    def texts(self, key: str) -> list[str]:
        """The list of texts under `key`."""
        return [Part(place, {"": value}).text("") for place, value in self._items(key, _MAX_ENTRIES)]

    def number(self, key: str) -> float | None:
        """The number under `key`, up to 1e15 in size or infinite; None also for NaN."""
        value = self.entries.get(key)
        if value is None:
            return None
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise _unexpected(self._at(key), "a number", value)
        if isinstance(value, float) and not math.isfinite(value):
            return None if math.isnan(value) else value
        if abs(value) > _MAX_NUMBER:
            raise InputError(f"{self._at(key)}: expected a number of at most {_MAX_NUMBER:g} in size")
        return float(value)

    def numbers(self, key: str) -> list[float]:
        """The list of finite numbers under `key`."""
        numbers = [(place, Part(place, {"": value}).number("")) for place, value in self._items(key)]
        for place, number in numbers:
            if number is None or math.isinf(number):
                raise InputError(f"{place}: expected a finite number")
        return [number for _, number in numbers if number is not None]

    def number_lists(self, key: str, at_most: int) -> list[list[float]]:
        """The list of lists of finite numbers under `key`."""
        return [Part(place, {"": value}).numbers("") for place, value in self._items(key, at_most)]

    def flag(self, key: str) -> bool | None:
        """True or False under `key`."""
        value = self.entries.get(key)
        if value is not None and not isinstance(value, bool):
            raise _unexpected(self._at(key), "true or false", value)
        return value

    def flat(self) -> list[tuple[str, str]]:
        """All values as texts, with their names: `fit.seed`. Lists of values are one text."""
        rows = _flat(self.entries)
        _check_count(self.place, len(rows), _MAX_ENTRIES)
        return rows

    def _at(self, key: str) -> str:
        if not key:
            return self.place
        return f"{self.place}{'' if self.place.endswith(': ') else '.'}{clean(key)}"

    def _items(self, key: str, at_most: int = _MAX_ENTRIES) -> list[tuple[str, object]]:
        value = self.entries.get(key)
        if value is None:
            return []
        place = self._at(key)
        if not isinstance(value, list):
            raise _unexpected(place, "a list", value)
        _check_count(place, len(value), at_most)
        return [(f"{place}[{index}]", item) for index, item in enumerate(value)]


def read_audit(run: Path) -> Part:
    """RUN/audit/audit.json. Raises InputError when it is missing, broken, too large or of another version."""
    path = run / AUDIT / "audit.json"
    if not path.exists():
        raise InputError(f"{path}: expected an audit, found nothing there; `keyss audit {run}` makes one")
    try:
        data = json.loads(read_file(path, _MAX_BYTES))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not readable as JSON ({error})") from error
    if not isinstance(data, dict):
        raise _unexpected(str(path), "an object", data)
    audit = Part(f"{path}: ", data)
    if audit.number("version") != VERSION:
        raise InputError(
            f"{path}: expected version {VERSION} of an audit, found {clean(_plain(data.get('version')))}; "
            f"`keyss audit {run}` makes a new one"
        )
    return audit


@dataclass(frozen=True)
class Picture:
    """A picture as a page holds it."""

    width: int  # pixels
    height: int
    url: str  # data:


class Pictures:
    """The pictures of an audit: PNG files in its folder."""

    def __init__(self, run: Path) -> None:
        self._folder = run / AUDIT
        self._left = _MAX_PICTURES

    def read(self, part: Part, key: str) -> Picture | None:
        """The picture that the audit names under `key`, if it names one.

        Raises InputError when it lies outside the audit's folder, is missing, is no PNG or too large.
        """
        name = part.text(key)
        if not name:
            return None
        path = self._inside(part.place, name)
        data = read_file(path, min(_MAX_PICTURE, self._left))
        if not data.startswith(_PNG):
            raise InputError(f"{path}: expected a PNG picture")
        width, height, _ = probe_image(path)
        self._left -= len(data)
        return Picture(width, height, "data:image/png;base64," + b64encode(data).decode())

    def _inside(self, place: str, name: str) -> Path:
        try:
            folder = self._folder.resolve()
            path = (folder / name).resolve()
        except (OSError, RuntimeError, ValueError) as error:  # loops of links, names that cannot be
            raise InputError(f"{place}: expected the name of a picture, found {name!r}") from error
        if not path.is_relative_to(folder):
            raise InputError(f"{place}: expected a picture in {self._folder}, found {name!r}")
        return path


def clean(text: str) -> str:
    """One line of at most 1,000 characters, none of which controls, reorders or cannot be encoded."""
    text = text[: _MAX_TEXT - 1] + "…" if len(text) > _MAX_TEXT else text
    return "".join(
        c if c.isprintable() else " " if c.isspace() else "\N{REPLACEMENT CHARACTER}" for c in text
    )


def _part(place: str, value: object) -> Part:
    if value is None:
        return Part(place, {})
    if not isinstance(value, dict):
        raise _unexpected(place, "an object", value)
    return Part(place, value)


def _flat(entries: dict[str, object], depth: int = 0) -> list[tuple[str, str]]:
    rows: list[tuple[str, str]] = []
    for name, value in entries.items():
        if isinstance(value, dict) and depth < _MAX_DEPTH:
            rows += [(f"{clean(name)}.{inner}", text) for inner, text in _flat(value, depth + 1)]
        else:
            rows.append((clean(name), clean(_plain(value))))
    return rows


def _plain(value: object, depth: int = 0) -> str:
    match value:
        case None:
            return "none"
        case bool():
            return "yes" if value else "no"
        case str():
            return value
        case float():
            return f"{value:.6g}"
        case int():
            return str(value) if abs(value) <= _MAX_NUMBER else "a huge number"
        case list() if depth < _MAX_DEPTH:
            return ", ".join(_plain(item, depth + 1) for item in value[:_MAX_TEXT])
    return "…"


def _check_count(place: str, found: int, at_most: int) -> None:
    if found > at_most:
        raise InputError(f"{place}: expected at most {at_most:,} entries, found {found:,}")


def _unexpected(place: str, expected: str, found: object) -> InputError:
    kinds = {dict: "an object", list: "a list", str: "a text", bool: "true or false"}
    kind = "nothing" if found is None else kinds.get(type(found), "a number")
    return InputError(f"{place}: expected {expected}, found {kind}")
