"""A trial: one plain fit, or one hiding and its measures, in a folder of its own.

The folder holds the trial (`trial.json`), the results of `keyss fit` or `keyss hide` (`run/`) and, once it is
done, its numbers (`result.json`). A key is in none of these files.
"""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from itertools import zip_longest
from math import isfinite
from pathlib import Path
from typing import Any, cast

import msgspec

from keyss._version import __version__
from keyss.api.fit import fit
from keyss.api.hide import hide
from keyss.api.hide_arguments import Secret
from keyss.core import Scene, ViewOptions
from keyss.files import read_model, write_bytes
from keyss.fitting import FitConfig
from keyss.keys import MasterKey, read_key
from keyss.lab.audits import PARTS, audit
from keyss.lab.audits.subject import Subject
from keyss.lab.audits.trial_measures import MEASURES
from keyss.methods import MethodOptions, registry
from keyss.progress import Reporter
from keyss.rendering import Backend, resolve_device
from keyss.rendering.orbit import is_model
from keyss.runs import FitMetrics, HideMetrics, Manifest, read_manifest, read_record, record_bytes
from keyss.runs.estimates import seconds_for
from keyss.runs.files import METRICS, stego_in
from keyss.runs.folder import PRIVATE, make_private
from keyss.runs.open_run import HidingRun, open_run
from keyss.runs.planning import Cost, cost_of_fit

TRIAL, RESULT, RUN = "trial.json", "result.json", "run"
MASTER_KEY = f"{PRIVATE}/master-key.txt"  # relative to the folder of all trials


@dataclass(frozen=True, kw_only=True)
class Trial:
    """A hiding or, without secrets, a plain fit of the cover. Paths are absolute.

    Paths of plain models of other trials are relative to the trial's folder.
    """

    keyss: str = __version__
    name: str  # display name
    labels: dict[str, Any] = field(default_factory=dict)  # columns that name it in tables, beside its seed
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

    @property
    def identity(self) -> str:
        """SHA-256 (hexadecimal) of all that the run depends on: not of its measures."""
        same = replace(self, name="", labels={}, measures=())
        models = [path for path in self.models if path and os.path.isabs(path)]
        inputs = [self.cover, *self.secrets, *models]
        times = {path: os.stat(path).st_mtime_ns if os.path.exists(path) else 0 for path in inputs}
        return hashlib.sha256(record_bytes(same) + msgspec.json.encode(times)).hexdigest()

    @property
    def scenes(self) -> list[str]:
        """Names of the cover and the secrets."""
        paths = map(Path, (self.cover, *self.secrets))
        return [path.name if path.is_dir() else path.stem for path in paths]

    @property
    def fit(self) -> FitConfig:
        """The settings of its training."""
        return self.options if isinstance(self.options, FitConfig) else self.options.fit

    @property
    def needs(self) -> list[str]:
        """Names of the trials whose models it uses."""
        models = [path for path in (*self.models, *self.controls) if path and not os.path.isabs(path)]
        return [Path(path).parts[1] for path in models]


@dataclass(frozen=True, kw_only=True)
class Result:
    """The measured numbers of a finished trial: `result.json`."""

    version: int = 4
    keyss: str = __version__
    seconds: float  # duration of the attempt that finished it
    numbers: dict[str, float] = field(default_factory=dict)  # everything measured, by names with dots
    notes: dict[str, str] = field(default_factory=dict)  # on measures that were skipped
    measures: tuple[str, ...] = ()  # measures of the trial that are in `numbers`


def finished_result(trial: Trial, folder: Path) -> Result | None:
    """The result of a finished trial with all measures; None if it has to run."""
    result = _earlier_result(folder)
    return result if result is not None and {*trial.measures} <= {*result.measures} else None


def _earlier_result(folder: Path) -> Result | None:
    """The result in a trial's folder, possibly without some measures."""
    return read_record(folder / RESULT, Result) if (folder / RESULT).exists() else None


def run_trial(trial: Trial, folder: Path, reporter: Reporter) -> Result:
    """Fit or hide, measure, and write `result.json`; resumes an interrupted attempt. Raises KeyssError."""
    start, before = time.monotonic(), _earlier_result(folder)
    make_private(folder)
    write_bytes(folder / TRIAL, record_bytes(trial))
    if before is None:
        before = Result(seconds=0.0, numbers=_fit_or_hide(trial, folder, reporter))
    missing = [measure for measure in trial.measures if measure not in before.measures]
    measured = _measure(trial, missing, folder, reporter) if missing else {}
    result = Result(
        seconds=round(time.monotonic() - start, 1),
        numbers=before.numbers
        | {name: value for name, value in measured.items() if not isinstance(value, str)},
        notes=before.notes | {name: value for name, value in measured.items() if isinstance(value, str)},
        measures=tuple(dict.fromkeys((*before.measures, *trial.measures))),
    )
    write_bytes(folder / RESULT, record_bytes(result))
    return result


def cost_of_trial(trial: Trial, folder: Path, read: Callable[[str, ViewOptions], Scene]) -> Cost:
    """The cost of a trial, without plain fits of other trials; `read` reads scenes. Raises KeyssError."""
    if isinstance(trial.options, FitConfig):
        return cost_of_fit(read(trial.cover, trial.views), trial.options, resolve_device(trial.device))
    keys = [f"key {index}" for index, _ in enumerate(trial.secrets)]
    keys = keys if registry.get(trial.method).capabilities.keys else []
    arguments = _hide_arguments(trial, folder, keys)
    # The frame of a given model depends on files in the folder of its scene.
    if arguments["cover_model"] is None and not is_model(trial.cover):
        arguments["cover"] = read(trial.cover, trial.views)
    arguments["secrets"] = [
        secret
        if secret.model is not None or is_model(secret.scene)
        else replace(secret, scene=read(secret.scene, trial.views))
        for secret in arguments["secrets"]
    ]
    cost = hide(**arguments, dry_run=True, reporter=Reporter()).cost
    assert cost is not None  # a dry run always has a cost
    elsewhere = [seconds for seconds, model in zip_longest(cost.fit_seconds, trial.models) if model]
    views = sum((PARTS.get(name) or MEASURES[name]).views for name in trial.measures)
    return replace(cost, seconds=cost.seconds - sum(elsewhere) + views * cost.view_seconds)


def keys_of(trial: Trial, folder: Path) -> list[str]:
    """A key per secret, derived from the master key; none if the method has no keys."""
    if not registry.get(trial.method).capabilities.keys:
        return []
    master = MasterKey(read_key(folder.parents[1] / MASTER_KEY))
    return [master.key_of(f"trial/{folder.name}/{index}") for index, _ in enumerate(trial.secrets, start=1)]


def opened_run(trial: Trial, folder: Path) -> HidingRun:
    """The run of a finished hiding."""
    return open_run(folder / RUN, keys_of(trial, folder))


def _fit_or_hide(trial: Trial, folder: Path, reporter: Reporter) -> dict[str, float]:
    run = folder / RUN
    manifest = read_manifest(run)
    if manifest.running is not None or manifest == Manifest():  # else it ended before the trial did
        more: dict[str, Any] = {"out": run, "resume": manifest.running is not None, "reporter": reporter}
        if trial.secrets:
            hide(**_hide_arguments(trial, folder, keys_of(trial, folder)), **more)
        else:
            config = cast(FitConfig, trial.options)
            fit(trial.cover, config=config, views=trial.views, device=trial.device, **more)
    kind: type[Any] = HideMetrics if trial.secrets else FitMetrics
    return flat(asdict(read_record(run / METRICS, kind)))


def flat(record: Any, prefix: str = "") -> dict[str, float]:
    """All finite numbers of a nested record, by dotted names."""
    if isinstance(record, int | float) and not isinstance(record, bool) and isfinite(record):
        return {prefix: float(record)}
    if isinstance(record, list | tuple):
        record = dict(enumerate(record, start=1))
    numbers: dict[str, float] = {}
    for name, value in record.items() if isinstance(record, dict) else ():
        numbers |= flat(value, f"{prefix}.{name}" if prefix else str(name))
    return numbers


def _hide_arguments(trial: Trial, folder: Path, keys: list[str]) -> dict[str, Any]:
    """The arguments of `hide`, without models that do not exist yet."""
    places = [path and _place(folder, path) for path in trial.models]
    cover, *models = (place if place and place.exists() else None for place in places)
    blank = [""] * len(trial.secrets)  # for methods without keys
    return {
        "cover": trial.cover,
        "secrets": [Secret(*secret) for secret in zip(trial.secrets, keys or blank, models, strict=True)],
        "method": trial.options,
        "views": trial.views,
        "cover_model": cover,
        "bound": trial.bound,
        "min_psnr": trial.min_psnr,
        "device": trial.device,
    }


def _place(folder: Path, path: str) -> Path:
    return Path(os.path.normpath(folder.absolute() / path))


def _measure(trial: Trial, names: list[str], folder: Path, reporter: Reporter) -> dict[str, float | str]:
    """Numbers of measures, or notes on them."""
    numbers: dict[str, float | str] = {}
    if parts := [name for name in names if name in PARTS]:
        keys = keys_of(trial, folder)
        audited = audit(folder / RUN, keys, only=parts, device=trial.device, reporter=reporter)
        for part in parts:
            numbers |= flat(audited.sections[part].numbers, f"audit.{part}")
    if others := [name for name in names if name not in PARTS]:
        device = resolve_device(trial.device)
        with reporter.waiting(f"opening {trial.name}", seconds_for("reveal", stego_in(folder / RUN))):
            controls = [read_model(_place(folder, path)).to(device) for path in trial.controls]
            subject = Subject(opened_run(trial, folder), device, controls)
            view_seconds = subject.view_seconds
        for name in others:
            measure = MEASURES[name]
            with reporter.waiting(f"{trial.name}: {name}", measure.views * view_seconds):
                numbers |= {f"{name}.{what}": value for what, value in measure.numbers(subject).items()}
    return numbers
