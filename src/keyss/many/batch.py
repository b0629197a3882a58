"""`hide_batch`: one hiding for each asset of a table; an asset that fails does not stop the others."""

from __future__ import annotations

import hashlib
import os
import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec

from keyss.core.errors import KeyssError, KeyssWarning, OutputError, UsageError
from keyss.core.scene import ViewOptions
from keyss.files.atomic import write_bytes
from keyss.keys.derivation import SALT_BYTES, DerivedKey
from keyss.keys.key_file import read_key_file
from keyss.many.assets import Asset, read_assets
from keyss.many.cell import CELL, RESULT, Cell
from keyss.many.running import (
    CELLS,
    RETRIES,
    ManyResult,
    Outcome,
    claimed,
    run_cells,
    settle_master_key,
)
from keyss.many.tables import csv_bytes
from keyss.methods import registry
from keyss.methods.base import MethodOptions
from keyss.rendering import Backend
from keyss.rendering.orbit import is_model
from keyss.runs.folder import PRIVATE
from keyss.runs.records import read_record
from keyss.runs.sources import PathLike

SUMMARY = f"{PRIVATE}/batch.csv"


def hide_batch(
    manifest: PathLike,
    out: PathLike,
    *,
    method: str | MethodOptions = registry.DEFAULT,
    master_key_file: PathLike | None = None,
    width: int | None = None,
    background: tuple[float, float, float] | None = None,
    skip_missing: bool = False,
    min_psnr: float = 20.0,
    device: Backend = "auto",
    jobs: int | None = None,
    ray: str | None = None,
    retries: int = RETRIES,
    overwrite: bool = False,
) -> ManyResult:
    """Hide a secret in each cover of a table (see `keyss.many.assets`), each in its own folder below `out`.

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
        read_key_file(master)
    covers = Counter(os.path.realpath(asset.cover) for asset in assets if is_model(asset.cover))
    if again := [cover for cover, times in covers.items() if times > 1]:
        warnings.warn(
            f"{len(again)} of the covers ({Path(again[0]).name}) are published more than once: comparing two "
            "published files of one cover shows that both hide something; give each asset a cover of its own",
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
    """The asset's cell. Raises InputError, OutputError and UsageError where it must not begin."""
    if asset.secret_file is not None and not is_model(asset.cover):
        raise UsageError(f"{asset.cover}: files are hidden in models, and this is not the name of one")
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
    check = "" if asset.key_file is None else _key_check(read_key_file(asset.key_file), identity)
    cell = replace(cell, id=f"{identity}{check}")
    try:
        there = place.is_file() or (place.is_dir() and any(place.iterdir()))
        before = read_record(folder / CELL, Cell) if (folder / CELL).exists() else None
    except OSError as error:
        raise OutputError(f"cannot write {place}: {error.strerror}") from error
    if before is None or before.id != cell.id:
        if there and not overwrite:
            what = "is there, and not from this batch"
            what = what if before is None else "was made with another key, or from other inputs or options"
            raise OutputError(f"{place} {what}: `overwrite=True` replaces what keyss wrote there")
        (folder / RESULT).unlink(missing_ok=True)
    return cell


def _key_check(key: str, identity: str) -> str:
    """Recognises the key of a cell; a guess costs as much as one at the published file."""
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
