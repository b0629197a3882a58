"""Images and gradients against the dense float64 reference."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from rendering.clear_cut import clear_cut
from rendering.dense_reference import dense_rasterization
from rendering.scenes import DIFFERENTIABLE, SCENES, Scene

IMAGE_ERROR = 1e-5  # absolute
GRADIENT_ERROR = 1e-4  # the largest difference by the largest gradient


def draw_densely(
    scene: Scene, leaves: dict[str, Tensor], shifts: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Images and alphas in the layout of `rasterization`."""
    drawn = [
        dense_rasterization(
            **scene.dense_arguments(leaves, camera), shifts=None if shifts is None else shifts[camera]
        )
        for camera in range(len(scene.viewmats))
    ]
    return torch.stack([image for image, _ in drawn]), torch.stack([alpha[..., None] for _, alpha in drawn])


def errors(scene: Scene) -> dict[str, float]:
    """Absolute errors of images and alphas, relative errors of gradients."""
    exact, ours = scene.leaves(torch.float64), scene.leaves(torch.float32)
    # For the gradients of means2d; too large for the scene with 10,000 Gaussians.
    shifts = None
    if len(scene.means) <= 200:
        pixels = scene.height * scene.width
        shifts = torch.zeros(len(scene.viewmats), len(scene.means), pixels, 2, dtype=torch.float64)
        shifts.requires_grad_()
    image, alpha = draw_densely(scene, exact, shifts)
    images, alphas, meta = scene.draw(ours)
    assert images.shape == image.shape
    found = {
        "image": float((images - image).detach().abs().max()),
        "alpha": float((alphas - alpha).detach().abs().max()),
    }

    generator = torch.Generator().manual_seed(99)
    image_weights = torch.randn(image.shape, generator=generator)
    alpha_weights = torch.randn(alpha.shape, generator=generator)
    ((image * image_weights).sum() + (alpha * alpha_weights).sum()).backward()
    ((images * image_weights).sum() + (alphas * alpha_weights).sum()).backward()
    gradients = {name: (ours[name].grad, exact[name].grad) for name in DIFFERENTIABLE}
    if shifts is not None:
        assert shifts.grad is not None
        gradients["means2d"] = (meta["means2d"].grad, shifts.grad.sum(2))
    for name, (gradient, expected) in gradients.items():
        assert gradient is not None
        assert expected is not None
        largest = expected.abs().max()
        found[f"gradient of {name}"] = float((gradient - expected).abs().max() / largest)
    return found


def check(scene: Scene) -> None:
    for what, error in errors(clear_cut(scene)).items():
        bound = GRADIENT_ERROR if what.startswith("gradient") else IMAGE_ERROR
        assert error <= bound, f"{what}: {error:.1e}"


@pytest.mark.parametrize("name", SCENES)
def test_image_and_gradients(name: str) -> None:
    check(SCENES[name]())
