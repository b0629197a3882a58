"""A cell: one plain fit, or one hiding and its measures, in a folder of its own.

| file | what |
| --- | --- |
| `cell.json` | the cell |
| `result.json` | its numbers; there only when it is done |
| `run/` | the results of `keyss fit` or `keyss hide` |

A key is in none of these files.
"""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, replace
from math import isfinite
from pathlib import Path
from typing import Any, cast

import msgspec

from keyss._version import __version__
from keyss.api.fit import fit
from keyss.api.hide import hide
from keyss.api.hide_arguments import Secret
from keyss.core import ViewOptions
from keyss.files import write_bytes
from keyss.fitting import FitConfig
from keyss.keys import MasterKey, read_key
from keyss.lab.audits import PARTS, audit
from keyss.lab.audits.comparison_measures import MEASURES, Subject
from keyss.methods import MethodOptions, registry
from keyss.methods.base import Plan, role_of
from keyss.methods.plain_models import plain_stage
from keyss.progress import Reporter
from keyss.rendering import Backend, resolve_device
from keyss.runs import FitMetrics, HideMetrics, Manifest, read_manifest, read_record, record_bytes
from keyss.runs.files import METRICS, as_scene, model_in
from keyss.runs.folder import make_private
from keyss.runs.open_run import open_run
from keyss.runs.planning import plan_fit

CELL, RESULT, RUN = "cell.json", "result.json", "run"


@dataclass(frozen=True, kw_only=True)
class Cell:
    """A hiding or, without secrets, a plain fit of the cover. Paths are absolute.

    Paths of plain models of other cells are relative to the cell's folder.
    """

    keyss: str = __version__
    name: str  # display name
    cover: str  # a scene, or a model
    secrets: tuple[str, ...] = ()
    models: tuple[str | None, ...] = ()  # plain models of the cover and of each secret
    controls: tuple[str, ...] = ()  # plain models of the cover that some measures compare with
    method: str = ""
    options: MethodOptions | FitConfig
    views: ViewOptions = field(default_factory=ViewOptions)
    min_psnr: float | None = 0.0
    bound: bool = False
    device: Backend = "auto"
    measures: tuple[str, ...] = ()  # beyond those of `keyss hide`
    master_key_file: str | None = None

    @property
    def identity(self) -> str:
        """SHA-256 (hexadecimal) of the version of keyss, options and input paths.

        Measures and the master key are not included, because the run does not depend on them.
        """
        same = replace(self, name="", measures=(), master_key_file=None)
        return hashlib.sha256(record_bytes(same)).hexdigest()

    @property
    def needs(self) -> list[str]:
        """Names of the cells whose models it uses."""
        models = [each for each in (*self.models, *self.controls) if each and not os.path.isabs(each)]
        return [Path(each).parts[1] for each in models]

    def is_stale(self, folder: Path) -> bool:
        """True if the result is older than an input, or the model was removed."""
        models = [each for each in self.models if each and os.path.isabs(each)]
        inputs = [self.cover, *self.secrets, *models]
        gone = (folder / RESULT).exists() and model_in(folder / RUN) is None
        return gone or changed_since(folder / RESULT, inputs)


@dataclass(frozen=True, kw_only=True)
class Result:
    """The measured numbers of a finished cell: `result.json`."""

    version: int = 3
    keyss: str = __version__
    seconds: float  # duration of the attempt that finished it
    numbers: dict[str, float] = field(default_factory=dict)  # everything measured, by names with dots
    notes: dict[str, str] = field(default_factory=dict)  # on measures that were skipped or replaced
    measures: tuple[str, ...] = ()  # measures of the cell that are in `numbers`


def earlier_result(cell: Cell, folder: Path) -> Result | None:
    """The result in a cell's folder, possibly without some measures; None if missing or stale."""
    if not (folder / RESULT).exists() or cell.is_stale(folder):
        return None
    return read_record(folder / RESULT, Result)


def result_of(cell: Cell, folder: Path) -> Result | None:
    """The result of a finished cell with all measures; None if it has to run."""
    result = earlier_result(cell, folder)
    return result if result is not None and {*cell.measures} <= {*result.measures} else None


def changed_since(result: Path, inputs: Iterable[str | Path]) -> bool:
    """True if the file `result` exists and is older than one of the files or folders."""
    times = [os.stat(each).st_mtime for each in inputs if os.path.exists(each)]
    return result.exists() and max(times, default=0.0) > result.stat().st_mtime


def run_cell(cell: Cell, folder: Path, reporter: Reporter) -> Result:
    """Fit or hide, measure, and write `result.json`; resumes an interrupted attempt. Raises KeyssError."""
    start, before = time.monotonic(), earlier_result(cell, folder)
    make_private(folder)
    write_bytes(folder / CELL, record_bytes(cell))
    if before is None:
        before = Result(seconds=0.0, numbers=(_hide if cell.secrets else _fit)(cell, folder, reporter))
    missing = [each for each in cell.measures if each not in before.measures]
    measured = _measure(cell, missing, folder, reporter) if missing else {}
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
    assert found is not None  # a dry run always has a plan
    fits = {plain_stage(role_of(index, 1 + count)) for index, each in enumerate(cell.models) if each}
    return replace(found, stages=tuple(each for each in found.stages if each.name not in fits))


def keys_of(cell: Cell, folder: Path) -> list[str]:
    """A key per secret, derived from the master key, or "" if the method has no keys."""
    if not registry.get(cell.method).capabilities.keys or cell.master_key_file is None:
        return [""] * len(cell.secrets)
    master = MasterKey(read_key(Path(cell.master_key_file)))
    return [master.key_of(f"cell/{folder.name}/{index}") for index, _ in enumerate(cell.secrets, start=1)]


def flat(record: Any, prefix: str = "") -> dict[str, float]:
    """All finite numbers of a nested record, by dotted names."""
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
    """The arguments of `hide`, without models that do not exist yet."""
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


def _measure(cell: Cell, names: list[str], folder: Path, reporter: Reporter) -> dict[str, float | str]:
    """Numbers of measures, or notes on them."""
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
