"""Runs resume on another device."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from fitting.small_trainings import FIT, training
from fitting.test_plain import InterruptAt
from keyss.core import Interrupted
from keyss.fitting import FitConfig, TrainingRun, fit_scene, train
from tiny_scenes import tiny_scene


def test_device_alias(tmp_path: Path) -> None:
    """ "cpu:0" is the device "cpu"."""
    scene, path = tiny_scene(), tmp_path / "checkpoint.safetensors"
    with pytest.raises(Interrupted):
        fit_scene(scene, FIT, checkpoint=path, reporter=InterruptAt(25))
    there = torch.device("cpu", 0)
    resumed = fit_scene(scene, FIT, device=there, checkpoint=path, resume=True).gaussians
    assert torch.equal(resumed.means, fit_scene(scene, FIT).gaussians.means)


def train_run(name: str, fit: FitConfig, device: str = "cpu", **options: Any) -> TrainingRun:
    run: TrainingRun = training(name, fit, torch.device(device))
    train(run, name, fingerprint={}, **options)
    return run


@pytest.mark.cuda
@pytest.mark.parametrize("name", ["plain", "published", "gs-hider"])
def test_resume_across_devices(tmp_path: Path, name: str, cuda: torch.device) -> None:
    """Results differ slightly: the order of sums on a GPU varies."""
    path, fit = tmp_path / "checkpoint.safetensors", replace(FIT, iterations=60)
    with pytest.raises(Interrupted):
        train_run(name, fit, checkpoint=path, reporter=InterruptAt(25))
    with pytest.raises(Interrupted):
        train_run(name, fit, str(cuda), checkpoint=path, resume=True, reporter=InterruptAt(45))
    found = train_run(name, fit, checkpoint=path, resume=True)
    stayed = train_run(name, fit)
    assert abs(len(found) - len(stayed)) <= 0.05 * len(stayed)
    for what, psnr in stayed.evaluate().items():
        assert found.evaluate()[what] > psnr - 0.5, what
