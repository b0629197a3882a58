"""The table of a batch: a CSV file with a row for each asset.

| column | what |
| --- | --- |
| `cover` | model or scene that everybody may see |
| `secret`, or `secret_file` | scene or model to hide in it, or any file |
| `out` | folder of its results, in the batch's; it is also the asset's name under a master key |
| `key_file` | file with its key; left out where keys are derived from a master key |
"""

from __future__ import annotations

import csv
import io
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from keyss.core.errors import InputError, did_you_mean
from keyss.files.reading import read_text

MAX_BYTES = 64 << 20
MAX_ROWS = 1_000_000
COLUMNS = ("cover", "secret", "secret_file", "out", "key_file")
_OWN = "private"  # the folder of the batch's own files


@dataclass(frozen=True)
class Asset:
    """A row, with absolute paths."""

    line: int  # of the file
    cover: Path
    secret: Path | None
    secret_file: Path | None
    out: str  # as the file has it
    key_file: Path | None


def read_assets(path: Path, *, master: bool) -> list[Asset]:
    """All assets; paths are relative to the folder of the file. Raises InputError, which names the line.

    `master`: keys are derived, and no row names the file of one. Missing files are not an error here: they
    fail their own asset.
    """
    text = read_text(path, MAX_BYTES)
    try:
        rows = list(csv.reader(io.StringIO(text), strict=True))
    except csv.Error as error:
        raise InputError(f"{path}: expected CSV: {error}") from error
    if not rows:
        raise InputError(f"{path}: expected a first line with the names of columns, found nothing")
    heads = [head.strip() for head in rows[0]]
    _check_heads(path, heads, master)
    found: list[Asset] = []
    for line, cells in enumerate(rows[1:], start=2):
        if not any(cell.strip() for cell in cells):
            continue
        if len(cells) != len(heads):
            raise InputError(f"{path}, line {line}: expected {len(heads)} columns, got {len(cells)}")
        asset = _asset(path, line, dict(zip(heads, (cell.strip() for cell in cells), strict=True)), master)
        found.append(asset)
        if len(found) > MAX_ROWS:
            raise InputError(f"{path}: expected at most {MAX_ROWS:,} assets")
    _check_apart(path, found)
    if not found:
        raise InputError(f"{path}: expected at least one asset")
    return found


def _check_heads(path: Path, heads: list[str], master: bool) -> None:
    for head in heads:
        if head not in COLUMNS:
            raise InputError(f"{path}: no column is called {head[:60]!r}; {did_you_mean(head, COLUMNS)}")
    if len(set(heads)) < len(heads):
        raise InputError(f"{path}: a column is there twice")
    needed = {"cover", "out"} | (set() if master else {"key_file"})
    if missing := sorted(needed - set(heads)):
        more = "; keys come from it or from `master_key_file`" if "key_file" in missing else ""
        raise InputError(f"{path}: expected a column {missing[0]}{more}")
    if not {"secret", "secret_file"} & set(heads):
        raise InputError(f"{path}: expected a column secret or secret_file")
    if master and "key_file" in heads:
        raise InputError(f"{path}: leave out the column key_file: keys are derived from the master key")


def _check_apart(path: Path, assets: Sequence[Asset]) -> None:
    """Raise InputError for a folder of results that is that of another asset, or lies in it."""
    # File systems may take two spellings for one.
    places = [PurePosixPath(unicodedata.normalize("NFC", each.out).casefold()) for each in assets]
    lines: dict[PurePosixPath, int] = {}
    for asset, place in zip(assets, places, strict=True):
        if (other := lines.setdefault(place, asset.line)) != asset.line:
            raise InputError(f"{path}, line {asset.line}: out: {asset.out} is the folder of line {other}")
    for asset, place in zip(assets, places, strict=True):
        for parent in place.parents:
            if parent in lines:
                raise InputError(
                    f"{path}, line {asset.line}: out: {asset.out} lies in the folder of line {lines[parent]}"
                )


def _asset(path: Path, line: int, row: dict[str, str], master: bool) -> Asset:
    where = f"{path}, line {line}"

    def place(column: str) -> Path | None:
        value = row.get(column)
        if value and "\0" in value:
            raise InputError(f"{where}: {column}: expected a path, got {value!r}")
        return path.absolute().parent / value if value else None

    cover, out = place("cover"), row["out"]
    if cover is None:
        raise InputError(f"{where}: cover: expected a model or a scene, got nothing")
    secret, file = place("secret"), place("secret_file")
    if (secret is None) == (file is None):
        raise InputError(f"{where}: expected a secret or a secret_file, got {'both' if secret else 'none'}")
    key_file = place("key_file")
    if key_file is None and not master:
        raise InputError(f"{where}: key_file: expected the file of a key, got nothing")
    parts = PurePosixPath(out).parts
    if not parts or ".." in parts or parts[0] == "/" or parts[0].casefold() == _OWN or "\0" in out:
        raise InputError(
            f"{where}: out: expected the name of a folder in that of the batch, and not {_OWN}, got {out!r}"
        )
    return Asset(line, cover, secret, file, out, key_file)
