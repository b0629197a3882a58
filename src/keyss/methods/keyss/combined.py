"""Combined camera poses and combined SfM points (KeySS, section 3.4).

Every training pose of every scene supervises all scenes. A scene's target is its photo from that pose, or a
render of its plain 3DGS model if there is none. Everything is in the cover's frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from keyss.core.gaussians import Gaussians
from keyss.core.scene import Camera, Scene, View
from keyss.core.similarity import Similarity, align
from keyss.fitting.config import FitConfig
from keyss.fitting.losses import Target, Targets
from keyss.fitting.parameters import initial_gaussians, initial_points
from keyss.methods.base import Source, divide
from keyss.rendering import render

CACHE_BYTES = 2 << 30


@dataclass(frozen=True)
class PlacedScene:
    """A scene and its plain model, both moved into the cover's frame."""

    scene: Scene
    plain: Gaussians
    frame: Similarity  # own frame to cover frame

    @staticmethod
    def of(scene: Scene, plain: Gaussians, frame: Similarity) -> PlacedScene:
        """Move a scene and its plain model, both in the scene's own frame, by `frame`."""

        def move(views: Sequence[View]) -> tuple[View, ...]:
            return tuple(replace(view, camera=frame.apply_camera(view.camera)) for view in views)

        points = frame.apply_points(scene.points)
        placed = replace(scene, train=move(scene.train), test=move(scene.test), points=points)
        return PlacedScene(placed, frame.apply_gaussians(plain), frame)

    @staticmethod
    def all_of(sources: Sequence[Source]) -> list[PlacedScene]:
        """The cover, then the secrets, aligned with it by their cameras (ours; see `align`)."""
        cameras = [[view.camera for view in source.scene.train] for source in sources]
        frames = [Similarity(), *(align(each, cameras[0]) for each in cameras[1:])]
        return [PlacedScene.of(each.scene, each.model, at) for each, at in zip(sources, frames, strict=True)]


def combined_points(scenes: Sequence[Scene], fit: FitConfig, generator: torch.Generator) -> Gaussians:
    """Gaussians at the points of all scenes, in equal shares of the cap if there are enough points."""
    clouds = [initial_points(scene, fit.max_gaussians, generator) for scene in scenes]
    counts = divide([len(points) for points, _ in clouds], fit.max_gaussians)
    parts = [
        initial_gaussians(points, colors, fit.sh_degree, share, generator)
        for (points, colors), share in zip(clouds, counts, strict=True)
    ]
    return Gaussians.cat(parts)


class CombinedPoses:
    """All training poses of all scenes, and every scene's target at each of them."""

    def __init__(self, scenes: Sequence[PlacedScene], device: torch.device) -> None:
        self.scenes, self.device = scenes, device
        self.plains = [placed.plain.to(device) for placed in scenes]
        self._rendered: dict[tuple[int, int, int], Tensor] = {}
        self._bytes = 0
        self._targets = Targets()

    def camera(self, owner: int, index: int) -> Camera:
        """Training pose `index` of scene `owner`."""
        return self.scenes[owner].scene.train[index].camera

    def target(self, scene: int, owner: int, index: int) -> Target:
        """The target of `scene` at training pose `index` of `owner`."""
        own = self.scenes[owner].scene.train[index] if scene == owner else None

        def make() -> Target:
            image = own.image if own else self._render(scene, owner, index)
            return Target.of(image.to(self.device), own.mask if own else None)

        return self._targets.of((scene, owner, index), make)

    def _render(self, scene: int, owner: int, index: int) -> Tensor:
        """Render once, and cache as 8-bit pixels, like photos, up to CACHE_BYTES."""
        cached = self._rendered.get((scene, owner, index))
        if cached is not None:
            return cached
        with torch.no_grad():
            background = self.scenes[scene].scene.background
            image = render(self.plains[scene], self.camera(owner, index), background)
        pixels = (image.clamp(0, 1) * 255).round().to(torch.uint8).cpu()
        if self._bytes + pixels.numel() <= CACHE_BYTES:
            self._rendered[scene, owner, index] = pixels
            self._bytes += pixels.numel()
        return pixels
