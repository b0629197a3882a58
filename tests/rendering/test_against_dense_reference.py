"""Images and all gradients against the dense float64 reference."""

from __future__ import annotations

import pytest
import torch

from keyss.rendering import rasterization
from rendering.dense_reference import dense_rasterization
from rendering.toy_scenes import INPUT_NAMES, SCENES


@pytest.mark.parametrize("name", SCENES)
def test_image_and_gradients(name: str) -> None:
    scene = SCENES[name]()
    exact = scene.tensors(torch.float64)
    shifts = torch.zeros(len(scene.means), scene.height * scene.width, 2, dtype=torch.float64)
    image, alpha, clear = dense_rasterization(
        *exact[:6],
        scene.K,
        scene.width,
        scene.height,
        exact[6],
        scene.sh_degree,
        shifts=shifts.requires_grad_(),
        render_mode=scene.render_mode,
        rasterize_mode=scene.rasterize_mode,
    )
    ours = scene.tensors(torch.float32)
    images, alphas, meta = rasterization(
        *ours[:5],
        ours[5][None],
        scene.K.float()[None],
        scene.width,
        scene.height,
        sh_degree=scene.sh_degree,
        backgrounds=ours[6][None],
        absgrad=True,
        render_mode=scene.render_mode,
        rasterize_mode=scene.rasterize_mode,
    )
    assert clear.float().mean() > 0.8
    scale = max(1.0, float(image.detach().abs().max()))  # depths are not in [0, 1]
    assert images.shape[1:] == image.shape
    assert (images[0] - image)[clear].abs().max() <= 1e-5 * scale
    assert (alphas[0, ..., 0] - alpha)[clear].abs().max() <= 1e-5

    generator = torch.Generator().manual_seed(99)
    image_weights = torch.randn(image.shape, generator=generator) * clear[..., None]
    alpha_weights = torch.randn(alpha.shape, generator=generator) * clear
    ((image * image_weights).sum() + (alpha * alpha_weights).sum()).backward()
    ((images[0] * image_weights).sum() + (alphas[0, ..., 0] * alpha_weights).sum()).backward()
    gradients = {
        name: (tensor.grad, reference.grad)
        for name, tensor, reference in zip(INPUT_NAMES, ours, exact, strict=True)
    }
    assert shifts.grad is not None
    gradients["means2d"] = (meta["means2d"].grad[0], shifts.grad.sum(1))
    gradients["absgrad"] = (meta["means2d"].absgrad[0], shifts.grad.abs().sum(1))
    for input_name, (gradient, expected) in gradients.items():
        if expected is None:  # the colours, where only depths are drawn
            assert gradient is None
            continue
        assert gradient is not None
        error = (gradient - expected).norm() / expected.norm().clamp_min(1e-12)
        assert error <= 1e-4, f"{input_name}: relative gradient error {error:.2e}"
