"""RowAdam against torch's Adam."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from gsplat.strategy.ops import duplicate, remove, split
from torch import Tensor

from keyss.fitting import FitConfig, Parameters, RowAdam, make_optimizers, to_parameters
from tiny_scenes import random_gaussians

RATE, EPS = 0.01, 1e-15
SCALE = torch.cat([torch.ones(1, 1), torch.full((15, 1), 0.05)])


def _gradients(shape: tuple[int, ...], steps: int) -> Tensor:
    """Gradients of very different magnitudes, some of them zero as for invisible Gaussians."""
    generator = torch.Generator().manual_seed(1)
    values = torch.randn(steps, *shape, generator=generator)
    values *= 10 ** torch.randint(-12, 2, (1, *shape), generator=generator).double()
    return values * (torch.rand(steps, *shape, generator=generator) < 0.7)


def _run(make: Any, start: Tensor, gradients: Tensor) -> Tensor:
    parameter = torch.nn.Parameter(start.clone())
    optimizer = make(parameter)
    for gradient in gradients:
        parameter.grad = gradient.to(parameter.dtype)
        optimizer.step()
    return parameter.detach()


@pytest.mark.parametrize("shape", [(1,), (2049, 4), (700, 16, 3)])
def test_matches_torch(shape: tuple[int, ...]) -> None:
    start, gradients = torch.rand(shape), _gradients(shape, 20)
    ours = _run(lambda p: RowAdam(p, RATE), start, gradients)
    theirs = _run(lambda p: torch.optim.Adam([p], lr=RATE, eps=EPS), start.double(), gradients)
    assert (ours - theirs).abs().max() < 1e-6
    assert not torch.equal(ours, start)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_lr_scale(dtype: torch.dtype) -> None:
    """float64 uses torch's operations, as a GPU does."""
    start, gradients = torch.rand(500, 16, 3, dtype=torch.float64), _gradients((500, 16, 3), 20)
    ours = _run(lambda p: RowAdam(p, RATE, SCALE.to(dtype)), start.to(dtype), gradients)
    for part, rate in ((slice(0, 1), RATE), (slice(1, 16), 0.05 * RATE)):
        theirs = _run(
            lambda p, rate=rate: torch.optim.Adam([p], lr=rate, eps=EPS),
            start[:, part],
            gradients[:, :, part],
        )
        assert (ours[:, part] - theirs).abs().max() < 1e-6


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_row_scale(dtype: torch.dtype) -> None:
    start, gradients = torch.rand(3001, 3, dtype=torch.float64), _gradients((3001, 3), 20)
    factors = 2 * torch.rand(3001, dtype=torch.float64)

    def scaled(parameter: torch.nn.Parameter) -> RowAdam:
        optimizer = RowAdam(parameter, RATE)
        optimizer.scale_rows(factors)
        return optimizer

    ours = _run(scaled, start.to(dtype), gradients)
    whole = _run(lambda p: torch.optim.Adam([p], lr=RATE, eps=EPS), start, gradients)
    assert (ours - (start + factors[:, None] * (whole - start))).abs().max() < 2e-6


def test_densification() -> None:
    config, gaussians = FitConfig(), random_gaussians(120)

    def run(parameters: Parameters, optimizers: Any) -> dict[str, Tensor]:
        torch.manual_seed(0)
        for change in (duplicate, remove, split, None):
            for _ in range(4):
                count = len(parameters["means"])
                sh = _gradients((count, 16, 3), 1)[0].float()
                gradients = {"sh": sh, "sh0": sh[:, :1], "shN": sh[:, 1:]}
                for name, parameter in parameters.items():
                    shape = tuple(parameter.shape)
                    parameter.grad = gradients[name] if name in gradients else _gradients(shape, 1)[0].float()
                    optimizers[name].step()
            if change is not None:
                change(parameters, optimizers, {}, torch.arange(count) % 5 == 0)
        return {name: parameter.detach() for name, parameter in parameters.items()}

    parameters = to_parameters(gaussians, torch.device("cpu"))
    ours = run(parameters, make_optimizers(parameters, config, extent=1.0))
    parameters = to_parameters(gaussians, torch.device("cpu"))
    sh = parameters.pop("sh").detach()
    parameters["sh0"], parameters["shN"] = torch.nn.Parameter(sh[:, :1]), torch.nn.Parameter(sh[:, 1:])
    rates = {name: getattr(config, f"{name}_rate") for name in parameters}
    theirs = run(
        parameters,
        {name: torch.optim.Adam([parameters[name]], lr=rate, eps=EPS) for name, rate in rates.items()},
    )
    theirs["sh"] = torch.cat([theirs.pop("sh0"), theirs.pop("shN")], dim=1)
    assert len(ours["means"]) == 138
    for name, value in ours.items():
        assert torch.allclose(value, theirs[name], rtol=1e-6, atol=3e-6), name


@pytest.mark.cuda
def test_cuda_matches_cpu(cuda: torch.device) -> None:
    start, gradients = torch.rand(500, 16, 3), _gradients((500, 16, 3), 20)
    here, there = (
        _run(lambda p, d=d: RowAdam(p, RATE, SCALE.to(d)), start.to(d), gradients.to(d))
        for d in (torch.device("cpu"), cuda)
    )
    assert (here - there.cpu()).abs().max() < 1e-6


def test_low_bits_are_uniform() -> None:
    """Rounding the step before the subtraction would leave trailing zeros in small results.

    The bound of 5.2 standard deviations gives one false alarm in 1.2 million runs.
    """
    generator = torch.Generator().manual_seed(3)
    parameter = torch.nn.Parameter(1e-3 * torch.randn(400_000, generator=generator))
    optimizer = RowAdam(parameter, 1e-3)
    for _ in range(20):
        parameter.grad = parameter.detach() + 1e-3 * torch.randn(400_000, generator=generator)
        optimizer.step()
    small = parameter.detach()[parameter.detach().abs() < 2.0**-15].numpy().view("uint32")
    assert len(small) > 4000
    for bit in range(4):
        ones = float((small >> bit & 1).mean())
        assert abs(ones - 0.5) < 5.2 * 0.5 / len(small) ** 0.5, (bit, ones, len(small))
