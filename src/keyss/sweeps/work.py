"""What a job does: hide, measure, and gather the numbers."""

from __future__ import annotations

import os
import time
from dataclasses import asdict
from math import isfinite
from pathlib import Path
from typing import Any, cast

import msgspec

from keyss._verbs.asking import Secret
from keyss._verbs.filing import SecretFile, hide_files
from keyss._verbs.hiding import hide
from keyss.audit.run import audit
from keyss.core.errors import UsageError
from keyss.keys.key_file import read_key_file
from keyss.keys.master import MasterKey
from keyss.methods import registry
from keyss.methods.base import MethodOptions
from keyss.progress import reporter
from keyss.rendering import Backend
from keyss.runs.files import METRICS, stego_in
from keyss.runs.folder import Manifest, read_manifest
from keyss.runs.metrics import HideMetrics
from keyss.runs.records import read_record
from keyss.sweeps.job import RUN, Job, Result, checksum

# Numbers that are no measures: they differ from run to run, or say what was asked for.
_NO_MEASURES = ("seconds", "seed", "version", "width")


def perform(job: Job, folder: Path) -> Result:
    """Hide and measure; goes on from where an attempt before was interrupted. Raises KeyssError."""
    start = time.monotonic()
    run = Path(os.path.normpath(folder.absolute() / job.run))
    keys = keys_of(job)
    numbers = _hide_files(job, keys, run) if job.files else _hide(job, keys, run)
    if job.audit:
        done = "audit" in read_manifest(run).files
        resume = not done and read_manifest(run).running is not None
        found = audit(
            run,
            keys,
            only=job.audit,
            device=cast(Backend, job.device),
            overwrite=done,
            resume=resume,
            reporter=reporter(),
        )
        numbers |= {
            f"audit.{name}": value
            for part in job.audit
            for name, value in flat(msgspec.to_builtins(getattr(found, part)), part).items()
        }
    published = stego_in(run)
    return Result(
        name=job.name,
        seconds=round(time.monotonic() - start, 1),
        published=os.path.relpath(published, folder.absolute()),
        sha256=checksum(str(published)),
        numbers=numbers,
    )


def options_of(job: Job) -> MethodOptions:
    """The options as the method has them. Raises UsageError."""
    generic: Any = registry.get(job.method).options
    try:
        options: MethodOptions = msgspec.convert(job.options, generic)
    except msgspec.ValidationError as error:
        raise UsageError(f"options of the method {job.method}: {error}") from error
    return options


def keys_of(job: Job) -> list[str]:
    """A key for each secret, or "" where the method has none. Raises InputError for a file without a key."""
    if job.secrets and not registry.get(job.method).capabilities.keys:
        return [""] * len(job.secrets)
    if job.master_key_file is None:
        return [read_key_file(Path(each))[0] for each in job.key_files]
    master = MasterKey(read_key_file(Path(job.master_key_file))[0])
    return [master.key_of(each) for each in job.key_names]


def flat(record: Any, prefix: str = "") -> dict[str, float]:
    """Of what JSON can hold, all finite numbers that measure something, by names with dots between."""
    if isinstance(record, dict):
        pairs = [(str(name), each) for name, each in record.items() if name not in _NO_MEASURES]
    elif isinstance(record, list | tuple):
        pairs = [(str(index), each) for index, each in enumerate(record, start=1)]
    elif isinstance(record, int | float) and not isinstance(record, bool) and isfinite(record):
        return {prefix: float(record)}
    else:
        return {}
    found: dict[str, float] = {}
    for name, each in pairs:
        found |= flat(each, f"{prefix}.{name}" if prefix else name)
    return found


def _hide(job: Job, keys: list[str], run: Path) -> dict[str, float]:
    there = read_manifest(run)
    if there.running is None and "hide" in there.files and job.run == RUN:  # ended before the job did
        metrics = read_record(run / METRICS, HideMetrics)
    else:
        models = job.secret_models or (None,) * len(job.secrets)
        secrets = [Secret(*each) for each in zip(job.secrets, keys, models, strict=True)]
        metrics = hide(
            job.cover,
            secrets,
            method=options_of(job),
            width=job.width,
            background=job.background,
            skip_missing=job.skip_missing,
            cover_model=job.cover_model,
            min_psnr=job.min_psnr,
            device=cast(Backend, job.device),
            out=run,
            overwrite=there.running is None and there != Manifest(),
            resume=there.running is not None,
            reporter=reporter(),
        ).metrics
    return flat(asdict(metrics))


def _hide_files(job: Job, keys: list[str], run: Path) -> dict[str, float]:
    options = options_of(job)
    found = hide_files(
        job.cover,
        [SecretFile(file, key) for file, key in zip(job.files, keys, strict=True)],
        publish=options.publish,
        channel=options.channel,
        out=run,
        overwrite=read_manifest(run).files != {} or read_manifest(run).running is not None,
    )
    return {"psnr": found.psnr} | flat(list(found.sizes), "bytes")
