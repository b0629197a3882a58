"""Idle threads of torch, which spin in processes that import it before keyss."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
import torch

from keyss import FitConfig, _threads, fit
from keyss.core import KeyssWarning
from tiny_scenes import tiny_scene


@pytest.mark.parametrize(
    ("imports", "spinning"), [("torch, keyss", True), ("keyss, torch", False), ("torch", None)]
)
def test_spinning_idle_threads_of_torch_are_detected(imports: str, spinning: bool | None) -> None:
    """A choice of the user is not reported."""
    environment = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    if spinning is None:
        environment["OMP_WAIT_POLICY"] = "active"
    code = f"import {imports}; from keyss import _threads; print(_threads.spinning)"
    found = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert found.stdout.strip() == str(bool(spinning))


def test_training_warns_of_spinning_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_threads, "spinning", True)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    with pytest.warns(KeyssWarning, match="import keyss first"):
        fit(tiny_scene(0), config=FitConfig(iterations=1, max_gaussians=50, seed=0))
