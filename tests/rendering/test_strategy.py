"""gsplat's densification runs unchanged on what `rasterization` returns."""

from __future__ import annotations

import pytest
import torch
from gsplat import DefaultStrategy

from keyss.rendering import rasterization


@pytest.mark.parametrize("cameras", [2])
def test_default_strategy_grows_and_prunes(cameras: int) -> None:
    torch.manual_seed(0)
    count, size = 40, 48
    start = {
        "means": 0.5 * torch.randn(count, 3),
        "quats": torch.randn(count, 4),
        "scales": torch.full((count, 3), 0.1).log(),
        "opacities": torch.linspace(-8, 3, count),  # the first ones are below the threshold for pruning
        "sh0": torch.rand(count, 1, 3),
        "shN": torch.zeros(count, 3, 3),
    }
    params = torch.nn.ParameterDict({name: torch.nn.Parameter(value) for name, value in start.items()})
    optimizers = {name: torch.optim.Adam([params[name]], lr=1e-3) for name in params}
    strategy = DefaultStrategy(
        refine_start_iter=0,
        refine_every=5,
        grow_grad2d=1e-4,
        refine_scale2d_stop_iter=100,
        verbose=False,
    )
    strategy.check_sanity(params, optimizers)
    state = strategy.initialize_state(scene_scale=1.0)
    viewmats = torch.eye(4).repeat(cameras, 1, 1)
    viewmats[:, 2, 3] = 3
    viewmats[:, 0, 3] = 0.1 * torch.arange(cameras)
    K = torch.tensor([[50.0, 0, size / 2], [0, 50, size / 2], [0, 0, 1]])
    target = torch.rand(cameras, size, size, 3)
    sizes = []
    for step in range(1, 31):
        images, _, info = rasterization(
            params["means"],
            params["quats"],
            params["scales"].exp(),
            params["opacities"].sigmoid(),
            torch.cat([params["sh0"], params["shN"]], 1),
            viewmats,
            K.expand(cameras, 3, 3),
            size,
            size,
            sh_degree=1,
        )
        strategy.step_pre_backward(params, optimizers, state, step, info)
        (images - target).square().mean().backward()
        assert info["means2d"].grad.shape == (cameras, len(params["means"]), 2)
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        strategy.step_post_backward(params, optimizers, state, step, info, packed=False)
        sizes.append(len(params["means"]))
        if step == 5:
            assert (params["opacities"].sigmoid() >= 0.005).all()
    assert sizes[3] == count
    assert sizes[4] > count
    assert len(set(sizes)) >= 4  # it goes on to the end
    assert all(parameter.isfinite().all() for parameter in params.values())
