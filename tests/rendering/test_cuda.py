"""Both backends draw the same picture and give the same gradients.

No decision in these scenes is a close call, so that rounding alone cannot make the pictures differ. gsplat's
kernels compute in float32 with approximate exponentials and add up in any order: hence the tolerances.
"""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from keyss.core import BackendError
from keyss.rendering import resolve_device
from keyss.rendering.arguments import RASTERIZE_MODES, RENDER_MODES
from rendering.clear_cut import clear_cut
from rendering.scenes import COLORS, SCENES, Scene, scene_of_modes

pytestmark = pytest.mark.cuda

IMAGE_ERROR = 1e-4  # absolute, or relative to depths beyond 1
GRADIENT_ERROR = 0.02  # the norm of the difference by the norm


@pytest.fixture(scope="module")
def cuda() -> torch.device:
    try:
        return resolve_device("cuda")
    except BackendError as error:
        pytest.skip(str(error))


def along_motions(gradient: Tensor, viewmats: Tensor) -> Tensor:
    """[C, 3, 4] of a gradient by viewmats: how the loss changes as each camera turns (3x3) and shifts.

    gsplat finds the camera's position from the inverse of the matrix, and we by its transpose, so the entries
    differ. They agree on rigid motions, which is all that they are for.
    """
    rotation = gradient[:, :3] @ viewmats[:, :3].mT
    return torch.cat([rotation - rotation.mT, gradient[:, :3, 3:]], -1)


def results_on(device: torch.device, scene: Scene) -> dict[str, Tensor]:
    leaves = {name: leaf.detach().to(device).requires_grad_() for name, leaf in scene.leaves().items()}
    results = {name: tensor.cpu() for name, tensor in scene.results(leaves).items()}
    results["gradient of viewmats"] = along_motions(
        results["gradient of viewmats"], leaves["viewmats"].detach().cpu()
    )
    return results


def check_backends_agree(scene: Scene, cuda: torch.device) -> None:
    clear_cut(scene)
    ours = results_on(torch.device("cpu"), scene)
    theirs = results_on(cuda, scene)
    assert ours.keys() == theirs.keys()
    # Radii are rounded up: one may differ by a pixel, and at the border one more may be hidden.
    drawn = (ours["radii"] > 0).all(-1) & (theirs["radii"] > 0).all(-1)
    assert ((ours["radii"] - theirs["radii"]).abs() <= 1)[drawn].all()
    assert ((ours["radii"] > 0) == (theirs["radii"] > 0)).float().mean() > 0.98
    for name, other in theirs.items():
        mine = ours[name]
        assert mine.shape == other.shape, name
        if name == "radii":
            continue
        if name == "absgrad" and ours["images"].shape[-1] > 32:
            continue  # gsplat draws more than 32 channels in two parts, and keeps those of one
        if name in ("depths", "means2d", "gradient of means2d", "absgrad"):
            mine, other = mine[drawn], other[drawn]  # gsplat leaves anything there for the others
        if name in ("images", "alphas"):
            scale = max(1.0, float(other.abs().max()))
            assert (mine - other).abs().max() <= IMAGE_ERROR * scale, name
        else:
            error = (mine - other).norm() / other.norm().clamp_min(1e-9)
            assert error <= GRADIENT_ERROR, f"{name}: {error:.4f}"


@pytest.mark.parametrize("name", SCENES)
def test_backends_agree(name: str, cuda: torch.device) -> None:
    check_backends_agree(SCENES[name](), cuda)


@pytest.mark.parametrize("rasterize_mode", RASTERIZE_MODES)
@pytest.mark.parametrize("render_mode", RENDER_MODES)
@pytest.mark.parametrize("colors", COLORS)
def test_backends_agree_in_every_combination_of_modes(
    colors: int | str, render_mode: str, rasterize_mode: str, cuda: torch.device
) -> None:
    check_backends_agree(scene_of_modes(colors, render_mode, rasterize_mode), cuda)
