"""The trials of one folder: plain fits, hidings that use their models, and their outcomes.

Trials run one after the other in this process, or in parallel on a Ray cluster, whose nodes must have folders
and inputs under the same paths. Ray pickles trials between its own processes; keyss writes no pickles.
"""

from __future__ import annotations

import os
import traceback
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from keyss.core import BackendError, KeyssError, OutputError, UsageError, import_extra
from keyss.files import lock, write_bytes
from keyss.fitting import FitConfig
from keyss.keys import generate_key
from keyss.keys.key_file import LONG_KEY_LENGTH
from keyss.lab.audits.trial_measures import check_extras
from keyss.lab.many.trial import MASTER_KEY, RUN, Result, Trial, cost_of_trial, finished_result, run_trial
from keyss.methods import MethodOptions
from keyss.progress import Reporter, reporter as default_reporter
from keyss.rendering.orbit import is_model
from keyss.runs.files import MODEL, as_scene
from keyss.runs.folder import PRIVATE, check_not_published, make_private
from keyss.runs.planning import Cost

TRIALS = "trials"
_LOCAL = "local"  # a cluster of this machine
_SCENES, _READ_SECONDS = 3, 2.0  # scenes of photos that a forecast keeps in memory; to read one, about


@dataclass(frozen=True)
class Outcome:
    """The outcome of a trial."""

    trial: Trial
    folder: Path
    result: Result | None = None
    error: str | None = None  # the reason for a missing result
    skipped: bool = False  # True if it was finished before


@dataclass(frozen=True)
class Forecast:
    """The trials of a folder before they run, by their folders, in order."""

    names: Mapping[Path, str]
    costs: Mapping[Path, Cost]  # trials to run
    refused: Mapping[Path, str]  # reasons why trials cannot run


@dataclass
class TrialFolder:
    """Trials by their folders in `out`; equal trials share a folder."""

    out: Path
    common: Mapping[str, Any] = field(default_factory=dict)  # fields of all trials
    trials: dict[Path, Trial] = field(default_factory=dict)

    def plain(self, scene: str, config: FitConfig, note: str = "") -> str:
        """Add the plain fit of a scene; returns its model, relative to the folder of another trial.

        `note`: the end of its name, e.g. its seed or what it is for. Raises UsageError for a model.
        """
        if is_model(scene):
            raise UsageError("expected scenes, folders of photos: models have none to compare with")
        size = f"{config.iterations:,} steps, {config.max_gaussians:,} Gaussians"
        name = f"plain model of {Path(scene).name}, {size}{note and f', {note}'}"
        shared = {field: self.common[field] for field in ("views", "device")}
        return f"../{self._add(Trial(name=name, cover=scene, options=config, **shared)).name}/{RUN}/{MODEL}"

    def hiding(
        self,
        name: str,
        sources: Sequence[str],
        options: MethodOptions,
        models: Sequence[str | None],
        *,
        labels: Mapping[str, Any],
        measures: tuple[str, ...] = (),
        controls: Sequence[str] = (),
    ) -> Path:
        """Add a hiding after the plain fits that it uses; returns its folder. `sources`: cover, then secrets.

        Raises BackendError if packages for the measures are not installed.
        """
        check_extras(measures)
        trial = Trial(
            name=name,
            labels=dict(labels),
            cover=sources[0],
            secrets=tuple(sources[1:]),
            models=tuple(models),
            controls=tuple(controls),
            method=options.method,
            options=options,
            measures=measures,
            **self.common,
        )
        return self._add(trial)

    def _add(self, trial: Trial) -> Path:
        place = self.out / TRIALS / trial.identity
        self.trials.setdefault(place, trial)
        return place

    def run(
        self, ray: str | None = None, cores: int = 1, reporter: Reporter | None = None
    ) -> dict[Path, Outcome]:
        """Run all unfinished trials; returns outcomes by folder. An error of one does not stop the others.

        `ray`: HOST:PORT, ray://HOST:PORT, auto, or local for a cluster on this machine; None: this process.
        `cores`: cores per trial on Ray. Raises BackendError if the cluster cannot be reached, and KeyssError
        for other errors that concern all trials.
        """
        if cores < 1:
            raise UsageError(f"`cores`: expected at least 1, got {cores}")
        reporter = reporter or default_reporter()
        with claim_folder(self.out):
            if not (self.out / MASTER_KEY).exists():
                write_bytes(self.out / MASTER_KEY, f"{generate_key(LONG_KEY_LENGTH)}\n".encode())
            outcome_of = {
                folder: Outcome(trial, folder, result, skipped=True)
                for folder, trial in self.trials.items()
                if (result := finished_result(trial, folder)) is not None
            }
            due = {folder: trial for folder, trial in self.trials.items() if folder not in outcome_of}
            outcomes = _in_process(due, reporter) if ray is None or not due else _on_ray(due, ray, cores)
            for number, outcome in enumerate(outcomes, start=1):
                state = "failed" if outcome.error else "done"
                reporter.note(f"[{number}/{len(due)}] {outcome.trial.name}: {state}")
                outcome_of[outcome.folder] = outcome
        return {folder: outcome_of[folder] for folder in self.trials}

    def forecast(self, reporter: Reporter | None = None) -> Forecast:
        """The cost of each trial. Writes nothing."""
        costs, refused = {}, {}
        count = len(self.trials)
        scenes = {scene for trial in self.trials.values() for scene in (trial.cover, *trial.secrets)}
        read = lru_cache(_SCENES)(as_scene)
        with (reporter or default_reporter()).waiting(
            f"reading {len(scenes)} scenes, and estimating {count} runs", _READ_SECONDS * len(scenes)
        ) as done:
            for number, (place, trial) in enumerate(self.trials.items(), start=1):
                try:
                    if finished_result(trial, place) is None:
                        costs[place] = cost_of_trial(trial, place, read)
                except KeyssError as error:
                    refused[place] = str(error)
                done(number / count)
        return Forecast({place: trial.name for place, trial in self.trials.items()}, costs, refused)


@contextmanager
def claim_folder(out: Path) -> Iterator[None]:
    """Create the folder if necessary, and lock it while the block runs.

    Raises OutputError, also for folders inside `publish/`.
    """
    check_not_published(out)
    try:
        out.mkdir(parents=True, exist_ok=True, mode=0o700)
    except OSError as error:
        raise OutputError(f"cannot write {out}: {error.strerror}") from error
    make_private(out / PRIVATE)
    with lock(out / PRIVATE / "lock", out):
        yield


def _in_process(trials: Mapping[Path, Trial], reporter: Reporter) -> Iterator[Outcome]:
    ended: dict[Path, Outcome] = {}
    for folder, trial in trials.items():
        try:
            ended[folder] = _attempt(trial, folder, reporter, *_needed(trial, folder, ended))
        except KeyboardInterrupt as error:  # that of a training says how to resume a single run
            reporter.note("interrupted: the same command resumes")
            raise KeyboardInterrupt(*error.args) from error
        yield ended[folder]


def _needed(trial: Trial, folder: Path, started: Mapping[Path, Any]) -> list[Any]:
    """What `started` has of the trials whose models this one uses."""
    places = [folder.with_name(name) for name in trial.needs]
    return [started[place] for place in places if place in started]


def _attempt(trial: Trial, folder: Path, reporter: Reporter | None, *needed: Outcome) -> Outcome:
    """Run one trial; an error becomes a part of its outcome."""
    outcome = Outcome(trial, folder)
    if failed := [outcome.error for outcome in needed if outcome.error]:
        return replace(outcome, error=failed[0])
    try:
        return replace(outcome, result=run_trial(trial, folder, reporter or default_reporter()))
    except (KeyssError, OSError) as error:
        return replace(outcome, error=str(error))
    except Exception as error:  # e.g. a GPU out of memory
        traceback.print_exc()
        return replace(outcome, error=f"{type(error).__name__}: {error}")


def _on_ray(trials: Mapping[Path, Trial], address: str, cores: int) -> Iterator[Outcome]:
    """Ray starts a trial when those that it needs have ended, and repeats trials of lost nodes."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    ray = import_extra("ray", "cluster", "run on a cluster")
    where = {"include_dashboard": False} if address == _LOCAL else {"address": address}
    variables = {name: str(cores) for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS")}
    try:
        ray.init(log_to_driver=False, runtime_env={"env_vars": variables}, **where)
    except Exception as error:  # Ray raises many kinds of errors while it connects
        raise BackendError(f"cannot reach a Ray cluster at {address}: {error}") from error
    try:
        attempt = ray.remote(_attempt)
        started: dict[Path, Any] = {}
        for folder, trial in trials.items():
            chosen = attempt.options(name=trial.name, num_cpus=cores, num_gpus=int(trial.device == "cuda"))
            needed = _needed(trial, folder, started)
            started[folder] = chosen.remote(trial, folder.absolute(), None, *needed)
        running = {task: folder for folder, task in started.items()}
        while running:
            (done,), _ = ray.wait(list(running))
            folder = running.pop(done)
            try:
                yield replace(ray.get(done), folder=folder)
            except ray.exceptions.RayError as error:
                reason = f"lost by Ray: {str(error).strip().splitlines()[0]}"
                yield Outcome(trials[folder], folder, error=reason)
    finally:
        ray.shutdown()
