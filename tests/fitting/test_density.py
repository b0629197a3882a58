from __future__ import annotations

from typing import Any

import torch

from keyss.fitting import CappedStrategy, FitConfig, Optimizers, Parameters, make_optimizers, to_parameters
from tiny_scenes import random_gaussians

COUNT = 100


def _setup(max_gaussians: int) -> tuple[CappedStrategy, Parameters, Optimizers, dict[str, Any]]:
    config = FitConfig(max_gaussians=max_gaussians)
    parameters = to_parameters(random_gaussians(COUNT), torch.device("cpu"))
    optimizers = make_optimizers(parameters, config, extent=1.0)
    strategy = CappedStrategy(config)
    state = strategy.initialize_state(1.0)
    state["grad2d"] = torch.linspace(0, 1, COUNT)  # nearly all above the threshold
    state["count"] = torch.ones(COUNT)
    return strategy, parameters, optimizers, state


def test_growth_is_capped() -> None:
    strategy, parameters, optimizers, state = _setup(COUNT + 10)
    before = parameters["means"].detach().clone()
    strategy._grow_gs(parameters, optimizers, state, step=1000)
    assert len(parameters["means"]) == COUNT + 10
    kept = (parameters["means"].detach()[:, None] == before[None]).all(-1).any(0)
    # Splits replace only the ten Gaussians with the largest gradients.
    assert kept[:-10].all()


def test_never_prunes_everything() -> None:
    strategy, parameters, optimizers, state = _setup(COUNT)
    strategy.opacity_for_pruning = lambda: torch.zeros(COUNT)
    strategy._prune_gs(parameters, optimizers, state, step=1000)
    assert len(parameters["means"]) == COUNT
