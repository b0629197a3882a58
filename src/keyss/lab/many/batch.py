"""`hide_batch`: one hiding per asset of a table; a failed asset does not stop the others.

The table is a CSV file with the columns COLUMNS (docs/experiments.md).
"""

from __future__ import annotations

import csv
import hashlib
import io
import os
import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

from keyss._version import __version__
from keyss.api.hide import hide
from keyss.api.hide_arguments import Secret
from keyss.api.hide_files import SecretFile, hide_files
from keyss.core import InputError, KeyssWarning, ViewOptions
from keyss.core.errors import did_you_mean
from keyss.files import write_bytes
from keyss.files.inputs import read_text
from keyss.keys import MasterKey, read_key
from keyss.lab.many.engine import ManyResult, Outcome, claim_folder, run_tasks
from keyss.lab.many.result_tables import csv_bytes
from keyss.lab.many.trial import modification_times
from keyss.methods import MethodOptions, registry
from keyss.progress import Reporter
from keyss.rendering import Backend
from keyss.rendering.orbit import is_model
from keyss.runs import read_manifest, record_bytes, stego_in, write_record
from keyss.runs.files import PathLike
from keyss.runs.folder import PRIVATE

MAX_BYTES = 64 << 20
# A row has a secret (a scene or model) or a secret file, and a key file unless there is a master key. `out`
# is the folder of its results, and its name under the master key.
COLUMNS = ("cover", "secret", "secret_file", "out", "key_file")
SUMMARY = f"{PRIVATE}/batch.csv"
_RECORD = f"{PRIVATE}/asset.json"  # relative to the folder of a finished asset


@dataclass(frozen=True, kw_only=True)
class Asset:
    """A hiding, without its key."""

    keyss: str = __version__
    name: str  # folder of its results, relative to the batch's
    cover: str
    secret: str | None = None
    secret_file: str | None = None
    key_file: str
    options: MethodOptions
    views: ViewOptions
    min_psnr: float | None
    device: Backend
    times: dict[str, int]  # of modification, by input

    def is_done(self, place: Path) -> bool:
        """True if it was made from equal files and options by this version of keyss."""
        record = place / _RECORD
        return record.exists() and record.read_bytes() == record_bytes(self) and stego_in(place).exists()


def read_rows(path: Path, *, master: bool) -> dict[str, dict[str, str]]:
    """Read all rows, by `out`; other paths become absolute, and empty values are left out.

    `master`: keys are derived, and rows have no key file. Missing files are no error here, but fail their
    asset. Raises InputError with the line.
    """
    reader = csv.DictReader(io.StringIO(read_text(path, MAX_BYTES)), strict=True)
    found: dict[str, dict[str, str]] = {}
    try:
        heads = reader.fieldnames = [head.strip() for head in reader.fieldnames or ()]
        for head in heads:
            if head not in COLUMNS or heads.count(head) > 1:
                near = did_you_mean(head, COLUMNS)
                raise InputError(f"{path}: {head[:60]!r} is no column, or one twice; {near}")
        for row in reader:
            where = f"{path}, line {reader.line_num}"
            out, paths = _check_row(where, row, master)
            if out in found:
                raise InputError(f"{where}: out: {out!r} is the folder of an earlier line")
            found[out] = {name: os.path.realpath(path.parent / value) for name, value in paths.items()}
    except csv.Error as error:
        raise InputError(f"{path}: expected CSV: {error}") from error
    if not found:
        raise InputError(f"{path}: expected the names of columns, and at least one asset")
    return found


def _check_row(where: str, row: dict[str, str], master: bool) -> tuple[str, dict[str, str]]:
    """The folder of the results, and the other values that are not empty. Raises InputError."""
    if None in row or None in row.values():
        raise InputError(f"{where}: expected as many columns as there are names of them")
    given = {name: value.strip() for name, value in row.items() if value.strip()}
    if master == ("key_file" in given):
        what = "leave out the column key_file with a master key" if master else "expected a key_file"
        raise InputError(f"{where}: {what}: keys come from it or from `master_key_file`")
    if not {"cover", "out"} <= given.keys() or ("secret" in given) == ("secret_file" in given):
        raise InputError(f"{where}: expected a cover, out, and either a secret or a secret_file")
    out = given.pop("out")
    parts = PurePosixPath(out).parts
    if ".." in parts or out.startswith("/") or not parts or parts[0].casefold() == PRIVATE:
        raise InputError(f"{where}: out: expected a folder in the batch's, and not {PRIVATE}, got {out!r}")
    return out, given


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
    ray: str | None = None,
    cores: int = 1,
    overwrite: bool = False,
    reporter: Reporter | None = None,
) -> ManyResult:
    """Hide a secret in each cover of a table (see this module), each in its own folder below `out`.

    Finished assets are skipped; those with changed files or options fail without `overwrite`.
    `master_key_file`: derive each asset's key from this key and the column `out` (`keyss.keys.MasterKey`).
    `ray`, `cores`: see `keyss.sweep`; the other arguments are those of `hide`. Raises KeyssError for errors
    that concern all assets; the result has those of single assets.
    """
    master = None if master_key_file is None else Path(master_key_file).absolute()
    rows, out = read_rows(Path(manifest), master=master is not None), Path(out)
    if master is not None:
        read_key(master)
    _warn_of_covers([row["cover"] for row in rows.values() if is_model(row["cover"])])
    common: dict[str, Any] = {
        "options": registry.get(method).options() if isinstance(method, str) else method,
        "views": ViewOptions.of(width, background, skip_missing),
        "min_psnr": min_psnr,
        "device": device,
    }
    assets: dict[Path, Asset] = {}
    for name, row in rows.items():
        inputs: dict[str, Any] = {"key_file": str(master), **row}
        times = modification_times(inputs.values())
        assets[out / name] = Asset(name=name, times=times, **inputs, **common)
    with claim_folder(out, mode=0o777):
        done = {place for place, asset in assets.items() if asset.is_done(place)}
        found = {place: Outcome(assets[place].name, place, skipped=True) for place in done}
        due = {place: asset for place, asset in assets.items() if place not in done}
        work = partial(_hide, derived=master is not None, overwrite=overwrite)
        for outcome in run_tasks(work, due, ray=ray, cores=cores, reporter=reporter):
            found[outcome.folder] = outcome
        outcomes = [found[place] for place in assets]
        write_bytes(out / SUMMARY, _summary(out, outcomes))
    return ManyResult(tuple(outcomes), (SUMMARY,))


def _hide(asset: Asset, place: Path, reporter: Reporter, *, derived: bool, overwrite: bool) -> None:
    """Hide, and write the record of the asset. `derived`: its key file holds the master key."""
    key = read_key(Path(asset.key_file))
    key = MasterKey(key).key_of(asset.name) if derived else key
    if asset.secret_file is not None:
        secrets, options = [SecretFile(asset.secret_file, key)], asset.options
        hide_files(
            asset.cover,
            secrets,
            publish=options.publish,
            format=options.format,
            channel=options.channel,
            out=place,
            overwrite=overwrite,
        )
    elif asset.secret is not None:
        hide(
            asset.cover,
            [Secret(asset.secret, key)],
            method=asset.options,
            **vars(asset.views),
            min_psnr=asset.min_psnr,
            device=asset.device,
            out=place,
            overwrite=overwrite,
            resume=not overwrite and read_manifest(place).running is not None,
            reporter=reporter,
        )
    write_record(place / _RECORD, asset)


def _warn_of_covers(covers: Sequence[str]) -> None:
    """Warn of models that are published more than once."""
    if again := [cover for cover, times in Counter(covers).items() if times > 1]:
        warnings.warn(
            f"{len(again)} of the covers ({Path(again[0]).name}) are published more than once. Each file "
            "gets low bits of its own, but comparing two shows that both hide something: give each asset a "
            "cover of its own if others may have both",
            KeyssWarning,
            stacklevel=3,
        )


def _summary(out: Path, outcomes: Sequence[Outcome]) -> bytes:
    """CSV with a row per asset: its state, and the published file with its checksum, or the error."""
    rows = []
    for each in outcomes:
        row = {"out": each.name, "state": "failed", "published": "", "sha256": "", "error": each.error or ""}
        if each.error is None:
            stego = stego_in(each.folder)
            row |= {"state": "done", "published": os.path.relpath(stego, out)}
            row |= {"sha256": hashlib.sha256(stego.read_bytes()).hexdigest()}
        rows.append(row)
    return csv_bytes(rows)
