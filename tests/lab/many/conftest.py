"""Trials that take no time."""

from __future__ import annotations

from pathlib import Path

import pytest

from keyss.core import InputError
from keyss.files import write_bytes
from keyss.lab.many import trial, trial_folder
from keyss.progress import Reporter
from keyss.runs import record_bytes


def fake_run(job: trial.Trial, folder: Path, reporter: Reporter) -> trial.Result:
    """Numbers that depend on the seed; covers with "broken" or "odd" in their names fail."""
    if "broken" in Path(job.cover).name:
        raise InputError(f"{job.cover}: nothing of it can be read")
    if "odd" in Path(job.cover).name:
        raise RuntimeError("out of memory")
    seed = getattr(job.options, "fit", job.options).known_seed
    folder.mkdir(parents=True)
    numbers = {"cover.psnr": 30.0 + seed, "cover.ssim": 0.9, "secrets.1.psnr": 20.0, "seconds": 1.0}
    result = trial.Result(seconds=0.1, numbers=numbers)
    write_bytes(folder / "result.json", record_bytes(result))
    return result


@pytest.fixture
def _fake_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trial_folder, "run_trial", fake_run)
