"""Run one cell: fit or hide, measure, collect the numbers."""

from __future__ import annotations

import hashlib
import os
import time
from dataclasses import asdict, replace
from math import isfinite
from pathlib import Path
from typing import Any, cast

import msgspec

from keyss.api.asking import Secret
from keyss.api.fitting import fit
from keyss.api.hiding import hide
from keyss.audits import PARTS, audit
from keyss.core.errors import InputError, UsageError
from keyss.fitting.config import FitConfig
from keyss.keys.key_file import read_key
from keyss.keys.master import MasterKey
from keyss.many.cell import RUN, Cell, Result, error_of, result_of
from keyss.many.measures import MEASURES, Subject
from keyss.methods import registry
from keyss.methods.base import MethodOptions, Plan, role_of
from keyss.methods.plain_models import plain_stage
from keyss.progress import Reporter, reporter as default_reporter
from keyss.rendering import Backend, resolve_device
from keyss.runs.config import FitMetrics, HideMetrics
from keyss.runs.files import METRICS, MODEL, as_scene, stego_in
from keyss.runs.folder import Manifest, read_manifest
from keyss.runs.opening import open_run
from keyss.runs.planning import plan_fit
from keyss.runs.records import read_record


def perform(cell: Cell, folder: Path, reporter: Reporter | None = None) -> Result:
    """Fit or hide, and measure; resumes an interrupted attempt. Raises KeyssError."""
    start, reporter = time.monotonic(), reporter or default_reporter()
    run = _place(folder, cell.run)
    numbers: dict[str, float] = {}
    notes: dict[str, str] = {}
    if (before := result_of(folder)) is not None:  # for fewer measures
        numbers, notes = before.numbers, before.notes
    elif cell.fits:
        numbers = _fit(cell, run, reporter)
    else:
        numbers = _hide(cell, folder, run, reporter)
    missing = [each for each in cell.measures if before is None or each not in before.measures]
    for name, value in _measured(cell, missing, folder, run, reporter).items():
        if isinstance(value, str):
            notes[name] = value
        else:
            numbers[name] = value
    published = run / MODEL if cell.fits else stego_in(run)
    digest = hashlib.sha256(published.read_bytes()).hexdigest()
    return Result(
        name=cell.name,
        seconds=round(time.monotonic() - start, 1),
        published=os.path.relpath(published, folder.absolute()),
        sha256=digest,
        numbers=numbers,
        notes=notes,
        measures=cell.measures,
    )


def plan_of(cell: Cell, folder: Path) -> Plan:
    """The plan of a cell, without the plain fits of other cells. Raises KeyssError."""
    device = cast(Backend, cell.device)
    if cell.fits:
        scene = as_scene(cell.cover, cell.views, train_pictures=False)
        return plan_fit(scene, msgspec.convert(cell.options, FitConfig), resolve_device(device))
    found = hide(**_arguments(cell, folder, placeholders=True), dry_run=True).plan
    assert found is not None  # of a dry run
    count = 1 + len(cell.secrets)
    fits = {plain_stage(role_of(index, count)) for index, each in enumerate(cell.models) if each is not None}
    return replace(found, stages=tuple(each for each in found.stages if each.name not in fits))


def options_of(cell: Cell) -> MethodOptions:
    """The options of the method. Raises UsageError."""
    generic: Any = registry.get(cell.method).options
    try:
        options: MethodOptions = msgspec.convert(cell.options, generic)
    except msgspec.ValidationError as error:
        raise UsageError(f"options of the method {cell.method}: {error}") from error
    return options


def keys_of(cell: Cell) -> list[str]:
    """A key for each secret, or "" where the method has none. Raises InputError for a file without a key."""
    if cell.secrets and not registry.get(cell.method).capabilities.keys:
        return [""] * len(cell.secrets)
    if cell.master_key_file is None:
        return [read_key(Path(each)) for each in cell.key_files]
    master = MasterKey(read_key(Path(cell.master_key_file)))
    return [master.key_of(each) for each in cell.key_names]


def flat(record: Any, prefix: str = "") -> dict[str, float]:
    """All finite numbers of a nested record, by names joined with dots."""
    if isinstance(record, dict):
        pairs = [(str(name), each) for name, each in record.items()]
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


def _place(folder: Path, path: str) -> Path:
    return Path(os.path.normpath(folder.absolute() / path))


def _model(folder: Path, path: str) -> Path:
    """The path of a plain model, given or of another cell. Raises InputError if that cell failed."""
    place = _place(folder, path)
    if not os.path.isabs(path) and not place.exists():
        raise InputError(error_of(folder.parent / Path(path).parts[1]))
    return place


def _fit(cell: Cell, run: Path, reporter: Reporter) -> dict[str, float]:
    there = read_manifest(run)
    if there.running is not None or not (run / MODEL).exists():
        fit(
            cell.cover,
            config=msgspec.convert(cell.options, FitConfig),
            **vars(cell.views),
            device=cast(Backend, cell.device),
            out=run,
            resume=there.running is not None,
            reporter=reporter,
        )
    return flat(asdict(read_record(run / METRICS, FitMetrics)))


def _hide(cell: Cell, folder: Path, run: Path, reporter: Reporter) -> dict[str, float]:
    there = read_manifest(run)
    if there.running is None and "hide" in there.files and cell.run == RUN:  # ended before the cell did
        return flat(asdict(read_record(run / METRICS, HideMetrics)))
    resume = there.running is not None and not cell.files
    found = hide(
        **_arguments(cell, folder),
        out=run,
        overwrite=not resume and there != Manifest(),
        resume=resume,
        reporter=reporter,
    )
    if found.metrics is None:
        sizes = [Path(each).stat().st_size for each in cell.files]
        return flat({"psnr": found.psnr, "bytes": sizes})
    return flat(asdict(found.metrics))


def _arguments(cell: Cell, folder: Path, *, placeholders: bool = False) -> dict[str, Any]:
    """The arguments of `hide`. `placeholders`: for a dry run, without keys and missing models."""
    given = cell.models or (None,) * (1 + len(cell.secrets))
    if placeholders:
        has_keys = registry.get(cell.method).capabilities.keys
        keys = [f"key {index}" if has_keys else "" for index in range(len(cell.secrets))]
        places = [_place(folder, each) if each else None for each in given]
        cover, *models = (place if place and place.exists() else None for place in places)
    else:
        keys = keys_of(cell)
        cover, *models = (_model(folder, each) if each else None for each in given)
    options = options_of(cell)
    if cell.files:
        secrets = [Secret(file=file, key=key) for file, key in zip(cell.files, keys, strict=True)]
        return {
            "cover": cell.cover,
            "secrets": secrets,
            "publish": options.publish,
            "channel": options.channel,
        }
    return {
        "cover": cell.cover,
        "secrets": [Secret(*each) for each in zip(cell.secrets, keys, models, strict=True)],
        "method": options,
        **vars(cell.views),
        "cover_model": cover,
        "bound": cell.bound,
        "min_psnr": cell.min_psnr,
        "device": cell.device,
    }


def _measured(
    cell: Cell, names: list[str], folder: Path, run: Path, reporter: Reporter
) -> dict[str, float | str]:
    """The numbers of some measures, or texts with the reasons to skip them."""
    if not names:
        return {}
    keys, device = [key for key in keys_of(cell) if key], cast(Backend, cell.device)
    found: dict[str, float | str] = {}
    if parts := [name for name in names if name in PARTS]:
        there = read_manifest(run)
        done = "audit" in there.files
        audited = audit(
            run,
            keys,
            only=parts,
            device=device,
            overwrite=done,
            resume=not done and there.running is not None,
            reporter=reporter,
        )
        for part in parts:
            numbers = flat(msgspec.to_builtins(getattr(audited, part)), part)
            found |= {f"audit.{name}": value for name, value in numbers.items()}
    if others := [name for name in names if name not in PARTS]:
        controls = tuple(_model(folder, each) for each in cell.controls)
        subject = Subject(open_run(run, keys), device, controls)
        for name in others:
            found |= {f"{name}.{each}": value for each, value in MEASURES[name](subject).items()}
    return found
