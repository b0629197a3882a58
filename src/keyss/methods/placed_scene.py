"""Scenes in the frame of the cover."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.core.similarity import Similarity, align
from keyss.methods.method import Source


@dataclass(frozen=True)
class PlacedScene:
    """A scene and its plain model, both moved into the cover's frame."""

    scene: Scene
    plain: Gaussians
    frame: Similarity  # own frame to cover frame

    @staticmethod
    def of(scene: Scene, plain: Gaussians, frame: Similarity) -> PlacedScene:
        """Move a scene and its plain model, both in the scene's own frame, by `frame`."""
        train, test = (
            tuple(replace(view, camera=frame.apply_camera(view.camera)) for view in views)
            for views in (scene.train, scene.test)
        )
        placed = replace(scene, train=train, test=test, points=frame.apply_points(scene.points))
        return PlacedScene(placed, frame.apply_gaussians(plain), frame)

    @staticmethod
    def all_of(sources: Sequence[Source]) -> list[PlacedScene]:
        """The cover, then the secrets, aligned with it by their cameras (ours; see `align`)."""
        cameras = [[view.camera for view in source.scene.train] for source in sources]
        frames = [Similarity(), *(align(camera, cameras[0]) for camera in cameras[1:])]
        return [
            PlacedScene.of(source.scene, source.model, at) for source, at in zip(sources, frames, strict=True)
        ]
