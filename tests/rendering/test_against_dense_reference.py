"""Images and gradients against the dense float64 reference."""

from __future__ import annotations

import pytest
import torch

from rendering.clear_cut import clear_cut
from rendering.dense_reference import dense_rasterization
from rendering.scenes import DIFFERENTIABLE, SCENES, Scene

IMAGE_ERROR = 1e-5  # absolute
GRADIENT_ERROR = 1e-4  # the largest difference by the largest gradient


def errors(scene: Scene) -> dict[str, float]:
    """Absolute errors of image and alpha, relative errors of gradients."""
    leaves, shifts = scene.leaves(torch.float64), None
    if len(scene.means) <= 200:  # for the gradient of means2d; too large for the scene with 10,000 Gaussians
        shifts = torch.zeros(len(scene.means), scene.height * scene.width, 2, dtype=torch.float64)
        shifts.requires_grad_()
    image, alpha = dense_rasterization(**scene.dense_arguments(leaves), shifts=shifts)
    torch.autograd.backward([image, alpha], [each.to(image) for each in scene.weights()])
    exact = {f"gradient of {name}": leaves[name].grad for name in DIFFERENTIABLE}
    if shifts is not None and shifts.grad is not None:
        exact["gradient of means2d"] = shifts.grad.sum(1)[None]
    ours = scene.results()
    found = {}
    for name, expected in {"image": image.detach(), "alpha": alpha.detach(), **exact}.items():
        assert expected is not None
        assert ours[name].shape == expected.shape
        largest = float(expected.abs().max()) if name in exact else 1.0
        found[name] = float((ours[name] - expected).abs().max()) / largest
    return found


def check(scene: Scene) -> None:
    for what, error in errors(clear_cut(scene)).items():
        bound = GRADIENT_ERROR if what.startswith("gradient") else IMAGE_ERROR
        assert error <= bound, f"{what}: {error:.1e}"


@pytest.mark.parametrize("name", SCENES)
def test_image_and_gradients(name: str) -> None:
    check(SCENES[name]())
