"""Cameras, posed images, and a scene made of them."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor


@dataclass(frozen=True)
class Camera:
    """A pinhole camera without distortion, in OpenCV axes (x right, y down, z forward)."""

    viewmat: Tensor  # [4, 4] float32, world to camera, a rigid motion
    K: Tensor  # [3, 3] float32, pixels; pixel centres lie at half-integers
    width: int
    height: int
    name: str = ""

    @property
    def position(self) -> Tensor:
        """[3] centre of projection in the world."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]

    def resized(self, width: int, height: int) -> Camera:
        """The same view on another pixel grid: K is scaled per axis."""
        scale = torch.tensor([width / self.width, height / self.height, 1.0], dtype=self.K.dtype)
        return replace(self, K=self.K * scale[:, None].to(self.K), width=width, height=height)


@dataclass(frozen=True)
class View:
    """A camera and the photo it took."""

    camera: Camera
    image: Tensor  # [H, W, 3] uint8 sRGB
    drawn: Tensor | None = None  # [H, W, 3] in [0, 1], before it was rounded, where a model was drawn for it


@dataclass(frozen=True)
class Scene:
    """Posed images of one scene, split into training and test views, and its sparse points."""

    name: str
    train: tuple[View, ...]
    test: tuple[View, ...]
    points: Tensor  # [P, 3] float32 sparse reconstruction, may be empty
    colors: Tensor  # [P, 3] uint8 sRGB colours of the points
    background: Tensor = field(default_factory=lambda: torch.zeros(3))  # [3] in [0, 1], behind everything

    @property
    def views(self) -> tuple[View, ...]:
        """Training views, then test views."""
        return self.train + self.test

    @property
    def extent(self) -> float:
        """1.1 x the largest distance of a training camera from their mean (3DGS's `cameras_extent`).

        Of cameras in one place, where that is 0 and nothing would move: from what they look at.
        """
        cameras = [view.camera for view in self.train]
        positions = camera_positions(cameras)
        reach = float((positions - positions.mean(0)).norm(dim=1).max())
        if reach == 0:
            from keyss.core.alignment import focus_point  # which needs this module

            seen = self.points.double().mean(0) if len(self.points) else focus_point(cameras)
            reach = float((positions[0].double() - seen).norm())
        return 1.1 * reach

    def digest(self) -> str:
        """SHA-256 over all cameras, photos, points and the background: equal for equal content only."""
        state = hashlib.sha256(f"{len(self.train)} {len(self.test)}".encode())
        tensors = [self.points, self.colors, self.background]
        for view in self.views:
            tensors += [view.camera.viewmat, view.camera.K, view.image]
        for tensor in tensors:
            state.update(f"{tensor.dtype} {list(tensor.shape)}".encode())
            state.update(tensor.contiguous().numpy().tobytes())
        return state.hexdigest()


def camera_positions(cameras: Sequence[Camera]) -> Tensor:
    """[C, 3] centres of projection."""
    return torch.stack([camera.position for camera in cameras])
