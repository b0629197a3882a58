"""`hide_batch`: one hiding for each asset of a table; an asset that fails does not stop the others.

The table is a CSV file with a row for each asset:

| column | what |
| --- | --- |
| `cover` | model or scene that everybody may see |
| `secret`, or `secret_file` | scene or model to hide in it, or any file |
| `out` | folder of its results, in the batch's; it is also the asset's name under a master key |
| `key_file` | file with its key; left out where keys are derived from a master key |
"""

from __future__ import annotations

import csv
import hashlib
import io
import os
import unicodedata
import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import msgspec

from keyss.core.errors import InputError, KeyssError, KeyssWarning, OutputError, did_you_mean
from keyss.core.scene import ViewOptions
from keyss.files.atomic import write_bytes
from keyss.files.reading import read_text
from keyss.keys.derivation import SALT_BYTES, DerivedKey
from keyss.keys.key_file import read_key
from keyss.many.cell import CELL, RESULT, Cell
from keyss.many.running import CELLS, RETRIES, ManyResult, Outcome, claimed, run_cells, settle_master_key
from keyss.many.tables import csv_bytes
from keyss.methods import registry
from keyss.methods.base import MethodOptions
from keyss.rendering import Backend
from keyss.rendering.orbit import is_model
from keyss.runs.files import PathLike
from keyss.runs.folder import PRIVATE
from keyss.runs.records import read_record

MAX_BYTES = 64 << 20
MAX_ROWS = 1_000_000
COLUMNS = ("cover", "secret", "secret_file", "out", "key_file")
_OWN = "private"  # the folder of the batch's own files
SUMMARY = f"{PRIVATE}/batch.csv"


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
        raise InputError(f"{path}: two columns have the same name")
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
    # File systems may treat two spellings as the same name.
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


def hide_batch(
    manifest: PathLike,
    out: PathLike,
    *,
    method: str | MethodOptions = registry.DEFAULT,
    master_key_file: PathLike | None = None,
    width: int | None = None,
    background: tuple[float, float, float] | None = None,
    skip_missing: bool = False,
    min_psnr: float | None = None,
    device: Backend = "auto",
    jobs: int | None = None,
    ray: str | None = None,
    retries: int = RETRIES,
    overwrite: bool = False,
) -> ManyResult:
    """Hide a secret in each cover of a table (see `keyss.many.batch`), each in its own folder below `out`.

    Assets that are done are skipped; one whose cover, secret, key or options have changed since is refused
    unless with `overwrite`. `master_key_file`: its key and the column `out` give each asset a key of its own
    (`keyss.keys.master`). `jobs`, `ray`, `retries`: see `keyss.sweep`; the other arguments are those of
    `hide`. Raises KeyssError and its children for what concerns all; the result has what concerns one asset.
    """
    options = method
    if isinstance(options, str):
        options = registry.get(options).options()
    master = None if master_key_file is None else Path(master_key_file).absolute()
    assets, out = read_assets(Path(manifest), master=master is not None), Path(out)
    if master is not None:
        read_key(master)
    covers = Counter(os.path.realpath(asset.cover) for asset in assets if is_model(asset.cover))
    if again := [cover for cover, times in covers.items() if times > 1]:
        warnings.warn(
            f"{len(again)} of the covers ({Path(again[0]).name}) are published more than once. Each file "
            "gets low bits of its own, but comparing two shows that both hide something: give each asset a "
            "cover of its own if others may have both",
            KeyssWarning,
            stacklevel=2,
        )
    common: dict[str, Any] = {
        "views": ViewOptions.of(width, background, skip_missing),
        "min_psnr": min_psnr,
        "device": device,
        "method": registry.of_options(options).name,
        "options": msgspec.to_builtins(options),
    }
    with claimed(out, mode=0o777):
        if master is not None:
            settle_master_key(out, master)
        found: dict[str, Outcome] = {}
        cells: list[tuple[Cell, Path]] = []
        for asset in assets:
            folder = out / PRIVATE / CELLS / asset.out
            try:
                cells.append((_cell(asset, out, folder, master, common, overwrite), folder))
            except KeyssError as error:
                found[asset.out] = Outcome(asset.out, folder, None, str(error))
        ended = run_cells(f"batch of {len(assets)} assets", cells, jobs=jobs, ray=ray, retries=retries)
        found |= {each.name: each for each in ended}
        outcomes = [found[asset.out] for asset in assets]
        write_bytes(out / SUMMARY, _summary(out, outcomes))
    return ManyResult(tuple(outcomes), (SUMMARY,))


def _cell(
    asset: Asset, out: Path, folder: Path, master: Path | None, common: Mapping[str, Any], overwrite: bool
) -> Cell:
    """The asset's cell. Raises InputError and OutputError where it must not begin."""
    place = out / asset.out
    cell = Cell(
        name=asset.out,
        cover=os.path.realpath(asset.cover),
        secrets=() if asset.secret is None else (os.path.realpath(asset.secret),),
        files=() if asset.secret_file is None else (os.path.realpath(asset.secret_file),),
        run=os.path.relpath(place, folder),  # relative: the whole batch can be moved
        key_files=() if asset.key_file is None else (str(asset.key_file),),
        master_key_file=None if master is None else str(master),
        key_names=() if master is None else (asset.out,),
        **common,
    )
    identity = cell.identity
    check = "" if asset.key_file is None else _key_check(read_key(asset.key_file), identity)
    cell = replace(cell, id=f"{identity}{check}")
    try:
        there = place.is_file() or (place.is_dir() and any(place.iterdir()))
        before = read_record(folder / CELL, Cell) if (folder / CELL).exists() else None
    except OSError as error:
        raise OutputError(f"cannot write {place}: {error.strerror}") from error
    if before is None or before.id != cell.id:
        if there and not overwrite:
            what = "exists, and is not from this batch"
            what = what if before is None else "was made with another key, or from other inputs or options"
            raise OutputError(f"{place} {what}: `overwrite=True` replaces what keyss wrote there")
        (folder / RESULT).unlink(missing_ok=True)
    return cell


def _key_check(key: str, identity: str) -> str:
    """A value that recognises the key of a cell; testing a guess costs as much as at the published file."""
    salt = hashlib.sha256(b"keyss/v1/batch" + identity.encode()).digest()[:SALT_BYTES]
    return DerivedKey.of(key, salt).verifier().hex()


def _summary(out: Path, outcomes: Sequence[Outcome]) -> bytes:
    rows = []
    for each in outcomes:
        row = {"out": each.name, "state": "failed", "published": "", "sha256": "", "error": each.error or ""}
        if each.result is not None:
            published = os.path.normpath(each.folder / each.result.published)
            row |= {"state": "done", "published": os.path.relpath(published, out)}
            row |= {"sha256": each.result.sha256}
        rows.append(row)
    return csv_bytes(rows)
