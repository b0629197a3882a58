"""Both backends draw the same picture and give the same gradients."""

from __future__ import annotations

import pytest
import torch

from keyss.core import BackendError
from keyss.rendering import rasterization, resolve_device
from rendering.toy_scenes import INPUT_NAMES, SCENES

pytestmark = pytest.mark.cuda


@pytest.fixture(scope="module")
def cuda() -> torch.device:
    try:
        return resolve_device("cuda")
    except BackendError as error:
        pytest.skip(str(error))


@pytest.mark.parametrize("name", SCENES)
def test_backends_agree(name: str, cuda: torch.device) -> None:
    scene = SCENES[name]()
    results = []
    for device in (torch.device("cpu"), cuda):
        leaves = scene.tensors(torch.float32)
        inputs = [leaf.to(device) for leaf in leaves]
        images, alphas, meta = rasterization(
            *inputs[:5],
            inputs[5][None],
            scene.K.float()[None].to(device),
            scene.width,
            scene.height,
            sh_degree=scene.sh_degree,
            backgrounds=inputs[6][None],
            absgrad=True,
            render_mode=scene.render_mode,
            rasterize_mode=scene.rasterize_mode,
        )
        meta["means2d"].retain_grad()
        generator = torch.Generator().manual_seed(0)
        weights = torch.randn(images.shape, generator=generator).to(device)
        ((images * weights).sum() + (alphas * weights[..., :1]).sum()).backward()
        # The colours have none where only depths are drawn.
        gradients = [torch.zeros_like(leaf) if leaf.grad is None else leaf.grad for leaf in leaves]
        means2d = meta["means2d"]
        seen = (meta["radii"] > 0).all(-1, keepdim=True)
        gradients += [means2d.grad * seen, means2d.absgrad * seen]
        results.append([tensor.detach().cpu() for tensor in (images, alphas, meta["radii"], *gradients)])
    ours, theirs = results
    # A contribution of 1/255 may come or go by rounding, at few pixels.
    for mine, other in zip(ours[:2], theirs[:2], strict=True):
        different = (mine - other).abs().amax(-1) > 1e-4 * max(1.0, float(other.abs().max()))
        assert different.float().mean() <= 0.01
    assert ((ours[2] > 0) == (theirs[2] > 0)).float().mean() > 0.99
    for input_name, mine, other in zip(
        (*INPUT_NAMES, "means2d", "absgrad"), ours[3:], theirs[3:], strict=True
    ):
        error = (mine - other).norm() / other.norm().clamp_min(1e-9)
        assert error < 0.02, f"{input_name}: {error:.4f}"
