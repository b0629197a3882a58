"""The CPU and CUDA backends give the same images and gradients.

gsplat's kernels use approximate exponentials and sum in any order: hence the tolerances.
"""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from rendering.clear_cut import clear_cut
from rendering.scenes import SCENES, Scene

pytestmark = pytest.mark.cuda

IMAGE_ERROR = 1e-4  # absolute
GRADIENT_ERROR = 0.02  # the norm of the difference by the norm


def results_on(device: torch.device, scene: Scene) -> dict[str, Tensor]:
    leaves = {name: leaf.detach().to(device).requires_grad_() for name, leaf in scene.leaves().items()}
    return {name: tensor.cpu() for name, tensor in scene.results(leaves).items()}


def check_backends_agree(scene: Scene, cuda: torch.device) -> None:
    clear_cut(scene)
    ours = results_on(torch.device("cpu"), scene)
    theirs = results_on(cuda, scene)
    assert ours.keys() == theirs.keys()
    # Radii are rounded up and may differ by a pixel.
    drawn = (ours["radii"] > 0).all(-1) & (theirs["radii"] > 0).all(-1)
    assert ((ours["radii"] - theirs["radii"]).abs() <= 1)[drawn].all()
    assert ((ours["radii"] > 0) == (theirs["radii"] > 0)).float().mean() > 0.98
    for name, other in theirs.items():
        mine = ours[name]
        assert mine.shape == other.shape, name
        if name == "radii":
            continue
        if name in ("depths", "means2d", "gradient of means2d"):
            mine, other = mine[drawn], other[drawn]  # undefined elsewhere in gsplat
        if name in ("image", "alpha"):
            scale = max(1.0, float(other.abs().max()))
            assert (mine - other).abs().max() <= IMAGE_ERROR * scale, name
        else:
            error = (mine - other).norm() / other.norm().clamp_min(1e-9)
            assert error <= GRADIENT_ERROR, f"{name}: {error:.4f}"


@pytest.mark.parametrize("name", SCENES)
def test_backends_agree(name: str, cuda: torch.device) -> None:
    check_backends_agree(SCENES[name](), cuda)
