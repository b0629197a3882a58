from __future__ import annotations

from typing import Any

import pytest
import torch
from gsplat.strategy import DefaultStrategy

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


def test_growth_stops_at_the_cap_and_prefers_the_largest_gradients() -> None:
    strategy, parameters, optimizers, state = _setup(COUNT + 10)
    before = parameters["means"].detach().clone()
    strategy._grow_gs(parameters, optimizers, state, step=1000)
    assert len(parameters["means"]) == COUNT + 10
    kept = (parameters["means"].detach()[:, None] == before[None]).all(-1).any(0)
    # A split replaces its Gaussian: only the ten with the largest gradients may be gone.
    assert kept[:-10].all()


def test_never_prunes_everything() -> None:
    strategy, parameters, optimizers, state = _setup(COUNT)
    strategy.opacity_for_pruning = lambda: torch.zeros(COUNT)
    strategy._prune_gs(parameters, optimizers, state, step=1000)
    assert len(parameters["means"]) == COUNT


@pytest.mark.parametrize("cameras", [1, 3])
def test_statistics_are_equal_to_those_of_gsplat(cameras: int) -> None:
    strategy, parameters, _, _ = _setup(COUNT)
    generator = torch.Generator().manual_seed(0)
    ours, theirs = strategy.initialize_state(1.0), strategy.initialize_state(1.0)
    for _ in range(3):
        means2d = torch.zeros(cameras, COUNT, 2)
        means2d.grad = torch.randn(cameras, COUNT, 2, generator=generator)
        radii = torch.randint(-1, 4, (cameras, COUNT, 2), generator=generator, dtype=torch.int32).clamp_min(0)
        means2d.grad[(radii == 0).any(-1)] = torch.nan
        info = {"means2d": means2d, "radii": radii, "width": 201, "height": 133, "n_cameras": cameras}
        info["gaussian_ids"] = None
        strategy._update_state(parameters, ours, info)
        DefaultStrategy._update_state(strategy, parameters, theirs, info)
    assert ours["count"].max() > 2
    for name in ("grad2d", "count"):
        assert torch.equal(ours[name], theirs[name]), name
