"""Presets by device."""

from __future__ import annotations

import pytest
import torch

import keyss
from keyss.core import UsageError
from keyss.fitting import PRESETS, FitConfig
from keyss.fitting.config import preset_for
from keyss.methods import registry


def test_presets_of_a_gpu_are_those_of_3dgs() -> None:
    for size in ("default", "full"):
        config = preset_for(size, "cuda")
        assert (config.iterations, config.max_gaussians) == (30_000, 1_000_000)
        assert (config.grow_start, config.grow_stop) == (500 / 30_000, 15_000 / 30_000)
    assert preset_for("quick", "cuda") == PRESETS["quick"]
    for size, config in PRESETS.items():
        assert preset_for(size, "cpu") == config
    with pytest.raises(UsageError, match="expected quick or default or full"):
        preset_for("huge", "cuda")


@pytest.mark.parametrize("name", registry.METHODS)
def test_methods_take_preset_of_device(name: str) -> None:
    options = registry.options_of(name)
    assert options.preset("default", "cuda").fit == preset_for("default", "cuda")
    assert options.preset("default").fit == FitConfig()


class Reached(Exception):
    pass


def test_fit_takes_preset_of_device(monkeypatch: pytest.MonkeyPatch) -> None:
    configs = []

    def seen(config: FitConfig, *_: object) -> None:
        configs.append(config)
        raise Reached

    monkeypatch.setattr("keyss.api.fit.with_seed", seen)
    monkeypatch.setattr("keyss.api.fit.resolve_device", lambda device: torch.device(device))
    for device in ("cpu", "cuda"):
        with pytest.raises(Reached):
            keyss.fit("scene", device=device)
    assert configs == [preset_for("default", "cpu"), preset_for("default", "cuda")]
