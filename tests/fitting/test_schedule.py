"""Learning rates: those of 3DGS in long runs, larger ones in short runs."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from keyss.core import Camera
from keyss.fitting import FitConfig, Optimizers, Schedule, make_optimizers, to_parameters
from keyss.fitting.schedule import shrinking
from tiny_scenes import random_gaussians

RATES = {"means": 1.6e-4, "quats": 1e-3, "scales": 5e-3, "opacities": 5e-2, "sh": 2.5e-3}
EXTENT = 4.0


def _cameras(zoom: float = 1.15) -> list[Camera]:
    """Cameras at (0, 0, -1) and (0, 0, -5); `zoom` is the focal length for an image of unit area."""
    K = torch.tensor([[20 * zoom, 0, 10], [0, 20 * zoom, 20], [0, 0, 1]])
    poses = [torch.eye(4), torch.eye(4)]
    for pose, z in zip(poses, (1.0, 5.0), strict=True):
        pose[2, 3] = z
    return [Camera(pose, K, 10, 40) for pose in poses]


def _rates(config: FitConfig, iteration: int, means: Tensor | None = None) -> tuple[dict, Optimizers]:
    model = random_gaussians(5)
    model = model if means is None else replace(model, means=means)
    optimizers = make_optimizers(to_parameters(model, torch.device("cpu")), config, EXTENT)
    Schedule(config, _cameras(), EXTENT).set(optimizers, iteration)
    return {name: each.param_groups[0]["lr"] for name, each in optimizers.items()}, optimizers


@pytest.mark.parametrize("config", [FitConfig(iterations=30_000), FitConfig(iterations=900, boost=1.0)])
@pytest.mark.parametrize("progress", [0.0, 0.5, 1.0])
def test_rates_of_long_runs(config: FitConfig, progress: float) -> None:
    found, optimizers = _rates(config, round(progress * config.iterations))
    expected = RATES | {"means": EXTENT * RATES["means"] * 0.01**progress}
    assert found == pytest.approx(expected)
    assert not optimizers["means"].state


def test_rates_of_short_runs() -> None:
    config = FitConfig(iterations=1000)
    start, _ = _rates(config, 0)
    ratios = {"means": EXTENT * 5**1.75, "quats": 5, "scales": 5, "opacities": 5 ** (1 / 4), "sh": 5}
    assert {name: start[name] / RATES[name] for name in RATES} == pytest.approx(ratios, rel=1e-2)
    end, _ = _rates(config, 1000)
    assert {name: end[name] for name in ratios if name != "means"} == pytest.approx(
        {name: rate for name, rate in RATES.items() if name != "means"}
    )


def test_position_rates_follow_pixel_size() -> None:
    depths = torch.tensor([-0.9, 0.0, 1.0, 100.0, -3.1])
    means = torch.stack([torch.zeros(5), torch.zeros(5), depths], 1)
    _, optimizers = _rates(FitConfig(iterations=1000), 1, means)
    (state,) = optimizers["means"].state.values()
    distances = torch.tensor([0.1, 1.0, 2.0, 101.0, 1.9])
    assert torch.allclose(state["row_scale"], distances / EXTENT, atol=1e-5)
    config = FitConfig(iterations=1000)
    narrow = Schedule(config, _cameras(zoom=2.3), EXTENT).pixel_sizes(means)
    assert torch.allclose(narrow, distances / 2, atol=1e-5)


@pytest.mark.parametrize(
    ("width", "height", "factors"),
    [(200, 133, [1]), (400, 400, [1]), (780, 520, [4, 2, 1]), (3840, 2160, [16, 8, 4, 2, 1])],
)
def test_shrinking(width: int, height: int, factors: list[int]) -> None:
    config = FitConfig(iterations=1000)
    found = [shrinking(config, iteration, width * height) for iteration in range(1, 1001)]
    assert list(dict.fromkeys(found)) == factors
    assert found == sorted(found, reverse=True)
    if len(factors) > 1:
        steps = [found.count(factor) for factor in factors]
        assert steps[-1] == 500
        assert max(steps[:-1]) - min(steps[:-1]) <= 1
        assert width * height / factors[0] ** 2 >= 20_000 > width * height / (2 * factors[0]) ** 2
    assert {shrinking(replace(config, coarse=0), each, width * height) for each in (1, 1000)} == {1}
