"""The trials of one folder: plain fits, hidings that use their models, and their outcomes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from keyss.core import KeyssError
from keyss.files import write_bytes
from keyss.fitting import FitConfig
from keyss.keys import generate_key
from keyss.keys.key_file import KEY_LENGTH
from keyss.lab.audits.trial_measures import check_extras
from keyss.lab.many.engine import Outcome, claim_folder, run_tasks
from keyss.lab.many.trial import MASTER_KEY, RUN, Trial, finished_result, plan_of, run_trial
from keyss.methods import MethodOptions
from keyss.methods.base import Plan
from keyss.progress import Reporter
from keyss.runs.files import MODEL

TRIALS = "trials"


@dataclass(frozen=True)
class Forecast:
    """The trials of a folder before they run, by their folders, in order."""

    names: Mapping[Path, str]
    plans: Mapping[Path, Plan]  # trials to run
    refused: Mapping[Path, str]  # reasons why trials cannot run


@dataclass
class TrialFolder:
    """Trials by their folders in `out`; equal trials share a folder."""

    out: Path
    common: Mapping[str, Any] = field(default_factory=dict)  # fields of all trials
    trials: dict[Path, Trial] = field(default_factory=dict)

    def plain(self, scene: str, config: FitConfig) -> str:
        """Add the plain fit of a scene; returns its model, relative to the folder of another trial."""
        name = f"plain model of {Path(scene).name}, {config.iterations:,} steps, seed {config.seed}"
        shared = {each: self.common[each] for each in ("views", "device")}
        return f"../{self._add(Trial(name=name, cover=scene, options=config, **shared)).name}/{RUN}/{MODEL}"

    def hiding(
        self,
        name: str,
        sources: Sequence[str],
        options: MethodOptions,
        models: Sequence[str | None],
        *,
        measures: tuple[str, ...] = (),
        controls: Sequence[str] = (),
    ) -> Path:
        """Add a hiding after the plain fits that it uses; returns its folder. `sources`: cover, then secrets.

        Raises BackendError if packages for the measures are not installed.
        """
        check_extras(measures)
        trial = Trial(
            name=name,
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
        """Run all unfinished trials; returns outcomes by folder.

        The arguments are those of `run_tasks`. Raises KeyssError for errors that concern all trials.
        """
        found: dict[Path, Outcome] = {}
        with claim_folder(self.out):
            if not (self.out / MASTER_KEY).exists():
                write_bytes(self.out / MASTER_KEY, f"{generate_key(KEY_LENGTH)}\n".encode())
            for folder, trial in self.trials.items():
                if (result := finished_result(trial, folder)) is not None:
                    found[folder] = Outcome(trial.name, folder, result, skipped=True)
            due = {folder: trial for folder, trial in self.trials.items() if folder not in found}
            needs = {
                folder: [folder.with_name(each) for each in trial.needs] for folder, trial in due.items()
            }
            for outcome in run_tasks(run_trial, due, needs, ray=ray, cores=cores, reporter=reporter):
                found[outcome.folder] = outcome
        return {folder: found[folder] for folder in self.trials}

    def forecast(self) -> Forecast:
        """The plan of each trial. Writes nothing."""
        plans, refused = {}, {}
        for place, trial in self.trials.items():
            try:
                if finished_result(trial, place) is None:
                    plans[place] = plan_of(trial, place)
            except KeyssError as error:
                refused[place] = str(error)
        return Forecast({place: trial.name for place, trial in self.trials.items()}, plans, refused)
