"""A 3DGS model as gsplat's strategies expect it: a dict of parameters, each with its Adam.

The names `means quats scales opacities` (scales and opacities before their activation) are gsplat's, for
training only. Unlike in gsplat, all SH coefficients are one parameter, so no step concatenates them.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from keyss.core.gaussians import SH_C0, Gaussians
from keyss.core.neighbours import nearest_neighbours
from keyss.core.scene import Scene, camera_positions, focus_point
from keyss.fitting.adam import RowAdam
from keyss.fitting.config import FitConfig

INITIAL_OPACITY = 0.1
# Names of parameters, in the order of the fields of `Gaussians`.
_NAMES = ("means", "quats", "scales", "opacities", "sh")

Parameters = dict[str, torch.nn.Parameter]
Optimizers = dict[str, RowAdam]


def to_parameters(gaussians: Gaussians, device: torch.device) -> Parameters:
    """Copy the Gaussians into leaf parameters on `device`."""
    contiguous = torch.contiguous_format
    copy = gaussians.detach().to(device).map(lambda tensor: tensor.clone(memory_format=contiguous))
    return {
        name: torch.nn.Parameter(tensor) for name, tensor in zip(_NAMES, vars(copy).values(), strict=True)
    }


def to_gaussians(parameters: Parameters) -> Gaussians:
    """The Gaussians of the parameters, attached to their graph."""
    return Gaussians(*(parameters[name] for name in _NAMES))


def make_optimizers(parameters: Parameters, config: FitConfig, extent: float) -> Optimizers:
    """One Adam per attribute; the position's rate scales with the scene's `extent` (world units)."""
    sh_rate = max(config.sh0_rate, config.shN_rate) or 1.0
    sh_scale = parameters["sh"].new_full((parameters["sh"].shape[1], 1), config.shN_rate / sh_rate)
    sh_scale[0] = config.sh0_rate / sh_rate
    return {
        "means": RowAdam(parameters["means"], config.means_rate * extent),
        "quats": RowAdam(parameters["quats"], config.quats_rate),
        "scales": RowAdam(parameters["scales"], config.scales_rate),
        "opacities": RowAdam(parameters["opacities"], config.opacities_rate),
        "sh": RowAdam(parameters["sh"], sh_rate, sh_scale),
    }


def initial_gaussians(
    points: Tensor, colors: Tensor, sh_degree: int, limit: int, generator: torch.Generator
) -> Gaussians:
    """3DGS's start: at each sparse point an isotropic Gaussian as wide as the distance to its neighbours.

    points [P, 3] and colors [P, 3] uint8; `limit` of them are sampled if there are more.
    """
    if len(points) > limit:
        chosen = torch.randperm(len(points), generator=generator)[:limit].sort().values
        points, colors = points[chosen], colors[chosen]
    count = len(points)
    coordinates = points.double().numpy()
    distances = nearest_neighbours(coordinates, min(4, count))[0]
    spacing = torch.from_numpy(distances[:, 1:]).square().mean(1).sqrt() if count > 1 else torch.ones(1)
    sh = torch.zeros(count, (sh_degree + 1) ** 2, 3)
    sh[:, 0] = (colors.float() / 255 - 0.5) / SH_C0
    return Gaussians(
        means=points.float().clone(),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        log_scales=spacing.clamp_min(1e-7).log().float()[:, None].repeat(1, 3),
        opacity_logits=torch.full((count,), math.log(INITIAL_OPACITY / (1 - INITIAL_OPACITY))),
        sh=sh,
    )


def initial_points(
    scene: Scene, limit: int, generator: torch.Generator, model: Gaussians | None = None
) -> tuple[Tensor, Tensor]:
    """Points [P, 3] and colours [P, 3] uint8 to start from: the scene's own, a model's, or random ones.

    A scene with fewer than 100 points (NeRF-synthetic has none) gets those of its plain `model`. Without one,
    it gets grey ones, sampled uniformly from a cube around the focus of the cameras, whose edge is their mean
    distance from it.
    """
    if len(scene.points) >= 100:
        return scene.points, scene.colors
    if model is not None:
        return model.means, (255 * (SH_C0 * model.sh[:, 0] + 0.5).clamp(0, 1)).to(torch.uint8)
    cameras = [view.camera for view in scene.train]
    focus = focus_point(cameras)
    distance = camera_positions(cameras).double().sub(focus).norm(dim=1).mean()
    count = min(limit // 2, 20_000)  # half of the cap is for growth
    points = focus + (torch.rand(count, 3, generator=generator) - 0.5) * distance
    return points.float(), torch.full((count, 3), 128, dtype=torch.uint8)
