"""Renders of models as 8-bit images."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from keyss.core import Gaussians, Scene, View
from keyss.files.images import png_names
from keyss.fitting.image_metrics import subsample_views
from keyss.rendering import render


def select_views(views: Sequence[View]) -> list[View]:
    """At most 64 views, evenly spaced in the order of their names."""
    return list(subsample_views(sorted(views, key=lambda view: view.camera.name), 64))


@torch.no_grad()
def renders_of(model: Gaussians, scene: Scene, views: Sequence[View]) -> list[tuple[str, Tensor]]:
    """Names and uint8 renders [H, W, 3], on the CPU, of a model from the cameras of a scene's views."""
    background, renders = scene.background.to(model.device), []
    names = png_names(view.camera for view in views)
    for name, view in zip(names, views, strict=True):
        image = render(model, view.camera, background).clamp(0, 1)
        renders.append((name, (image * 255).round().to(torch.uint8).cpu()))
    return renders
