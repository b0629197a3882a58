"""Renders of models as 8-bit images."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from keyss.core import Camera, Gaussians, Scene, View
from keyss.core.arrays import Bytes
from keyss.files.images import png_names
from keyss.fitting.image_metrics import subsample_views
from keyss.measure.contact_sheet import contact_sheet
from keyss.rendering import render


def select_views(views: Sequence[View]) -> list[View]:
    """At most 64 views, evenly spaced in the order of their names."""
    return list(subsample_views(sorted(views, key=lambda view: view.camera.name), 64))


@torch.no_grad()
def renders_of(model: Gaussians, cameras: Sequence[Camera], background: Tensor) -> list[tuple[str, Tensor]]:
    """Names and uint8 renders [H, W, 3], on the CPU, of a model over a background [3]."""
    background, renders = background.to(model.device), []
    for name, camera in zip(png_names(cameras), cameras, strict=True):
        image = render(model, camera, background).clamp(0, 1)
        renders.append((name, (image * 255).round().to(torch.uint8).cpu()))
    return renders


def sheet_of(columns: Sequence[tuple[str, str, Scene, Gaussians]], views: int = 3) -> bytes:
    """A PNG of test views: for each role, kind of the scene's images, scene and model, image and render."""
    heads: list[str] = []
    pictures: list[list[Bytes]] = []
    for role, kind, scene, model in columns:
        shown = subsample_views(scene.test, views)
        renders = renders_of(model, [view.camera for view in shown], scene.background)
        heads += [f"{role}, {kind}", f"{role}, {'published' if not heads else 'revealed'}"]
        pictures += [[view.image.numpy() for view in shown], [image.numpy() for _, image in renders]]
    count = min(map(len, pictures))
    rows = {f"view {row + 1}": [column[row] for column in pictures] for row in range(count)}
    return contact_sheet(heads, rows)
