"""Run one cell: fit or hide, measure, collect the numbers."""

from __future__ import annotations

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
from keyss.audits.comparison_measures import MEASURES, Subject
from keyss.files.atomic import write_bytes
from keyss.fitting.config import FitConfig
from keyss.keys.key_file import read_key
from keyss.keys.master import MasterKey
from keyss.many.cell import CELL, RESULT, RUN, Cell, Result, earlier_result
from keyss.methods import registry
from keyss.methods.base import Plan, role_of
from keyss.methods.plain_models import plain_stage
from keyss.progress import Reporter
from keyss.rendering import resolve_device
from keyss.runs.config import FitMetrics, HideMetrics
from keyss.runs.files import METRICS, as_scene
from keyss.runs.folder import Manifest, make_private, read_manifest
from keyss.runs.opening import open_run
from keyss.runs.planning import plan_fit
from keyss.runs.records import read_record, record_bytes


def run_cell(cell: Cell, folder: Path, reporter: Reporter) -> Result:
    """Fit or hide, measure, and write `result.json`; resumes an interrupted attempt. Raises KeyssError."""
    start, before = time.monotonic(), earlier_result(cell, folder)
    make_private(folder)
    write_bytes(folder / CELL, record_bytes(cell))
    if before is None:
        before = Result(seconds=0.0, numbers=(_hide if cell.secrets else _fit)(cell, folder, reporter))
    missing = [each for each in cell.measures if each not in before.measures]
    measured = _measured(cell, missing, folder, reporter) if missing else {}
    result = Result(
        seconds=round(time.monotonic() - start, 1),
        numbers=before.numbers | {name: each for name, each in measured.items() if not isinstance(each, str)},
        notes=before.notes | {name: each for name, each in measured.items() if isinstance(each, str)},
        measures=tuple(dict.fromkeys((*before.measures, *cell.measures))),
    )
    write_bytes(folder / RESULT, record_bytes(result))
    return result


def plan_of(cell: Cell, folder: Path) -> Plan:
    """The plan of a cell, without the plain fits of other cells. Raises KeyssError."""
    if isinstance(cell.options, FitConfig):
        scene = as_scene(cell.cover, cell.views, train_pictures=False)
        return plan_fit(scene, cell.options, resolve_device(cell.device))
    has_keys, count = registry.get(cell.method).capabilities.keys, len(cell.secrets)
    keys = [f"key {index}" if has_keys else "" for index in range(count)]
    found = hide(**_arguments(cell, folder, keys), dry_run=True).plan
    assert found is not None  # of a dry run
    fits = {plain_stage(role_of(index, 1 + count)) for index, each in enumerate(cell.models) if each}
    return replace(found, stages=tuple(each for each in found.stages if each.name not in fits))


def keys_of(cell: Cell, folder: Path) -> list[str]:
    """A key for each secret, derived from the master key, or "" where the method has none."""
    if not registry.get(cell.method).capabilities.keys or cell.master_key_file is None:
        return [""] * len(cell.secrets)
    master = MasterKey(read_key(Path(cell.master_key_file)))
    return [master.key_of(f"cell/{folder.name}/{index}") for index, _ in enumerate(cell.secrets, start=1)]


def flat(record: Any, prefix: str = "") -> dict[str, float]:
    """All finite numbers of a nested record, by names joined with dots."""
    if isinstance(record, int | float) and not isinstance(record, bool) and isfinite(record):
        return {prefix: float(record)}
    pairs: list[tuple[Any, Any]] = []
    if isinstance(record, dict):
        pairs = list(record.items())
    elif isinstance(record, list | tuple):
        pairs = list(enumerate(record, start=1))
    found: dict[str, float] = {}
    for name, each in pairs:
        found |= flat(each, f"{prefix}.{name}" if prefix else str(name))
    return found


def _fit(cell: Cell, folder: Path, reporter: Reporter) -> dict[str, float]:
    run = folder / RUN
    there = read_manifest(run)
    if there.running is not None or there == Manifest():  # else it ended before the cell did
        fit(
            cell.cover,
            config=cast(FitConfig, cell.options),
            **vars(cell.views),
            device=cell.device,
            out=run,
            resume=there.running is not None,
            reporter=reporter,
        )
    return flat(asdict(read_record(run / METRICS, FitMetrics)))


def _hide(cell: Cell, folder: Path, reporter: Reporter) -> dict[str, float]:
    run = folder / RUN
    there = read_manifest(run)
    if there.running is not None or there == Manifest():
        keys = keys_of(cell, folder)
        hide(**_arguments(cell, folder, keys), out=run, resume=there.running is not None, reporter=reporter)
    return flat(asdict(read_record(run / METRICS, HideMetrics)))


def _arguments(cell: Cell, folder: Path, keys: list[str]) -> dict[str, Any]:
    """The arguments of `hide`; models that are not there yet are left out."""
    places = [each and _place(folder, each) for each in cell.models or (None,) * (1 + len(cell.secrets))]
    cover, *models = (place if place and place.exists() else None for place in places)
    return {
        "cover": cell.cover,
        "secrets": [Secret(*each) for each in zip(cell.secrets, keys, models, strict=True)],
        "method": cell.options,
        **vars(cell.views),
        "cover_model": cover,
        "bound": cell.bound,
        "min_psnr": cell.min_psnr,
        "device": cell.device,
    }


def _place(folder: Path, path: str) -> Path:
    return Path(os.path.normpath(folder.absolute() / path))


def _measured(cell: Cell, names: list[str], folder: Path, reporter: Reporter) -> dict[str, float | str]:
    """The numbers of some measures, or notes on them."""
    keys, run = [key for key in keys_of(cell, folder) if key], folder / RUN
    found: dict[str, float | str] = {}
    if parts := [name for name in names if name in PARTS]:
        there = read_manifest(run)
        done = "audit" in there.files
        resume = not done and there.running is not None
        more: dict[str, Any] = {"device": cell.device, "overwrite": done, "resume": resume}
        audited = audit(run, keys, only=parts, reporter=reporter, **more)
        for part in parts:
            found |= flat(msgspec.to_builtins(getattr(audited, part)), f"audit.{part}")
    if others := [name for name in names if name not in PARTS]:
        controls = tuple(_place(folder, each) for each in cell.controls)
        subject = Subject(open_run(run, keys), cell.device, controls)
        for name in others:
            found |= {f"{name}.{each}": value for each, value in MEASURES[name](subject).items()}
    return found
