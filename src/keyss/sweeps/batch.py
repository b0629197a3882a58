"""`hide_batch`: one hiding for each asset of a table; what is wrong with one does not stop the others."""

from __future__ import annotations

import csv
import hashlib
import io
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from keyss.core.errors import KeyssError, OutputError, UsageError
from keyss.files.atomic import write_bytes
from keyss.files.reading import read_text
from keyss.keys.derivation import SALT_BYTES, DerivedKey, KeyDerivation
from keyss.keys.key_file import read_key_file
from keyss.keys.master import MasterKey
from keyss.methods import registry
from keyss.methods.base import MethodOptions
from keyss.rendering import Backend
from keyss.rendering.orbit import is_model
from keyss.runs.config import PathLike
from keyss.runs.folder import check_not_published
from keyss.runs.records import read_record
from keyss.sweeps.engine import RETRIES
from keyss.sweeps.job import JOB, KEY_CHECK, LOG, RESULT, Failure, Job, Result, checksum, result_of
from keyss.sweeps.manifest import Asset, read_manifest
from keyss.sweeps.running import PRIVATE, Ended, How, Planned, claimed, make_private, run_all

SUMMARY = f"{PRIVATE}/batch.csv"
_JOBS, _CHECK = f"{PRIVATE}/jobs", f"{PRIVATE}/master-key-check.txt"


@dataclass(frozen=True)
class AssetResult:
    """What became of one asset."""

    out: str
    result: Result | None  # None: it failed
    error: str | None
    skipped: bool = False  # was done before


@dataclass(frozen=True)
class BatchResult:
    """What became of all assets, in the order of the table."""

    assets: tuple[AssetResult, ...]

    @property
    def failed(self) -> tuple[AssetResult, ...]:
        return tuple(each for each in self.assets if each.result is None)


def hide_batch(
    manifest: PathLike,
    out: PathLike,
    *,
    method: str | MethodOptions = "carry",
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
    how: How | None = None,
) -> BatchResult:
    """Hide a secret in each cover of a table (see `keyss.sweeps.manifest`), into a folder each below `out`.

    Assets that are done stay as they are; one whose cover, secret or options have changed since is refused
    unless with `overwrite`. `master_key_file`: its key and what stands in the column `out` give each asset a
    key of its own (`keyss.keys.master`). `jobs`, `ray`, `retries`, `how`: see `keyss.sweeps.sweep`; the other
    arguments are those of `hide`. Raises KeyssError and its children for what concerns all; what concerns one
    asset is in the result.
    """
    options = _options(method)
    master = None if master_key_file is None else Path(master_key_file).absolute()
    assets = read_manifest(Path(manifest), master=master is not None)
    check = None if master is None else MasterKey(read_key_file(master)[0]).check()
    out = Path(out)
    check_not_published(out)
    common: dict[str, Any] = {
        "width": width,
        "background": background,
        "skip_missing": skip_missing,
        "min_psnr": min_psnr,
        "device": device,
        "method": registry.of_options(options).name,
        "options": msgspec.to_builtins(options),
    }
    found: dict[int, AssetResult] = {}

    def work() -> list[Ended]:
        _check_master(out, check)
        earlier = _earlier(out)
        planned: dict[int, Planned] = {}
        for asset in assets:
            try:
                planned[asset.line] = _planned(asset, out, master, common, earlier, overwrite)
            except KeyssError as error:
                found[asset.line] = AssetResult(asset.out, None, str(error))
        asked = how or How(jobs, ray, retries)
        ended = run_all(f"batch of {len(assets)} assets", list(planned.values()), asked)
        for line, each in zip(planned, ended, strict=True):
            found[line] = _asset_result(each)
        write_bytes(out / SUMMARY, _summary([found[asset.line] for asset in assets]))
        return ended

    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot write {out}: {error.strerror}") from error
    claimed(out, work)
    return BatchResult(tuple(found[asset.line] for asset in assets))


def _options(method: str | MethodOptions) -> MethodOptions:
    if isinstance(method, MethodOptions):
        return method
    return next(iter(registry.get(method).presets.values()))


def _planned(
    asset: Asset,
    out: Path,
    master: Path | None,
    common: dict[str, Any],
    earlier: dict[str, set[str]],
    overwrite: bool,
) -> Planned:
    """The asset's job. Raises InputError, OutputError and UsageError for what cannot be begun."""
    if asset.secret_file is not None and not is_model(asset.cover):
        raise UsageError(f"{asset.cover}: files are hidden in models, and this is the name of none")
    key = None if asset.key_file is None else read_key_file(asset.key_file)[0]
    run = f"../../../{asset.out}"  # as seen from the job's folder: all of it may be moved
    place = out / asset.out
    job = Job(
        name=asset.out,
        cover=os.path.realpath(asset.cover),
        secrets=() if asset.secret is None else (os.path.realpath(asset.secret),),
        files=() if asset.secret_file is None else (os.path.realpath(asset.secret_file),),
        run=run,
        key_files=() if asset.key_file is None else (str(asset.key_file),),
        master_key_file=None if master is None else str(master),
        key_names=() if master is None else (asset.out,),
        **common,
    )
    name = job.identity({each: checksum(each) for each in job.inputs})
    folder = out / _JOBS / name
    others = earlier.get(run, set()) - {name}
    try:
        there = place.is_file() or (place.is_dir() and any(place.iterdir()))
    except OSError as error:
        raise OutputError(f"cannot write {place}: {error.strerror}") from error
    unfinished, known = result_of(folder) is None, name in earlier.get(run, ())
    check = None if key is None else _key_check(key, name)
    rekeyed = check is not None and (folder / KEY_CHECK).exists() and read_text(folder / KEY_CHECK) != check
    if there and not overwrite and (rekeyed or (unfinished and (others or not known))):
        what = "was made from other inputs or options" if others else "is there, and not from this batch"
        what = "was made with another key" if rekeyed else what
        raise OutputError(f"{place} {what}: `overwrite=True` replaces what keyss wrote there")
    if check is not None:
        make_private(folder)
        if rekeyed:
            (folder / RESULT).unlink(missing_ok=True)
        write_bytes(folder / KEY_CHECK, check.encode())
    return Planned.of(job, folder)


def _key_check(key: str, name: str) -> str:
    """By what the key of a job is known again; a guess costs as much as one at what is published."""
    salt = hashlib.sha256(b"keyss/v1/batch" + name.encode()).digest()[:SALT_BYTES]
    return DerivedKey(key, KeyDerivation(salt=salt)).verifier().hex()


def _earlier(out: Path) -> dict[str, set[str]]:
    """Of each folder of results the names of the jobs that have been begun for it."""
    found: dict[str, set[str]] = {}
    for path in sorted((out / _JOBS).glob(f"*/{JOB}")):
        found.setdefault(read_record(path, Job).run, set()).add(path.parent.name)
    return found


def _check_master(out: Path, check: str | None) -> None:
    """Raise OutputError for another master key than that of the assets which are there."""
    kept = out / _CHECK
    if check is None:
        return
    if not kept.exists():
        write_bytes(kept, check.encode())
    elif read_key_file(kept)[0] != check:
        raise OutputError(
            f"{out} holds assets with keys of another master key: give the same `master_key_file`, or choose "
            "another folder"
        )


def _asset_result(ended: Ended) -> AssetResult:
    error = None
    if ended.result is None:
        died = f"its process died again and again; its last words are in {ended.folder / LOG}"
        error = _said(ended.failure) or died
    return AssetResult(ended.name, ended.result, error, ended.skipped)


def _said(failure: Failure | None) -> str | None:
    return None if failure is None else failure.message


def _summary(assets: list[AssetResult]) -> bytes:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["out", "state", "published", "sha256", "error"])
    for each in assets:
        state = "failed" if each.result is None else "done"
        published = os.path.normpath(Path(_JOBS, "-", each.result.published)) if each.result else ""
        digest = each.result.sha256 if each.result else ""
        writer.writerow([each.out, state, published, digest, each.error or ""])
    return text.getvalue().encode("utf-8", "backslashreplace")
