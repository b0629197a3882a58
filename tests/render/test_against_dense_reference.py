"""Images and all gradients against the dense float64 reference."""

from __future__ import annotations

import pytest
import torch
from render.dense_reference import dense_rasterization
from render.toy_scenes import INPUT_NAMES, SCENES

from keyss.render import rasterization


@pytest.mark.parametrize("name", SCENES)
def test_image_and_gradients(name: str) -> None:
    scene = SCENES[name]()
    exact = scene.tensors(torch.float64)
    image, alpha, clear = dense_rasterization(
        *exact[:6], scene.K, scene.width, scene.height, exact[6], scene.sh_degree
    )
    ours = scene.tensors(torch.float32)
    images, alphas, _ = rasterization(
        *ours[:5],
        ours[5][None],
        scene.K.float()[None],
        scene.width,
        scene.height,
        sh_degree=scene.sh_degree,
        backgrounds=ours[6][None],
    )
    assert clear.float().mean() > 0.8
    assert (images[0] - image)[clear].abs().max() <= 1e-5
    assert (alphas[0, ..., 0] - alpha)[clear].abs().max() <= 1e-5

    generator = torch.Generator().manual_seed(99)
    image_weights = torch.randn(image.shape, generator=generator) * clear[..., None]
    alpha_weights = torch.randn(alpha.shape, generator=generator) * clear
    ((image * image_weights).sum() + (alpha * alpha_weights).sum()).backward()
    ((images[0] * image_weights).sum() + (alphas[0, ..., 0] * alpha_weights).sum()).backward()
    for input_name, reference, tensor in zip(INPUT_NAMES, exact, ours, strict=True):
        assert reference.grad is not None
        assert tensor.grad is not None
        error = (tensor.grad - reference.grad).norm() / reference.grad.norm().clamp_min(1e-12)
        assert error <= 1e-4, f"{input_name}: relative gradient error {error:.2e}"
