"""Cameras, posed images, and a scene made of them."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians

# Near plane, in world units, of scenes with at least ORDINARY_EXTENT between cameras. Smaller scenes have a
# proportionally smaller one.
NEAR, ORDINARY_EXTENT = 0.01, 0.5
_ROUNDING = 1e-6  # relative error of a camera's position in single precision

# Weight of the fallback point in `focus_point`, against a mean of projections with eigenvalues of at most 1:
# it dominates if the viewing axes differ by less than about two degrees.
_FALLBACK_WEIGHT = 1e-3


@dataclass(frozen=True)
class Camera:
    """A pinhole camera without distortion, in OpenCV axes (x right, y down, z forward)."""

    viewmat: Tensor  # [4, 4] float32, world to camera, a rigid motion
    K: Tensor  # [3, 3] float32, pixels; pixel centres lie at half-integers
    width: int
    height: int
    name: str = ""
    near: float = NEAR  # near plane, in world units

    @property
    def position(self) -> Tensor:
        """[3] centre of projection in the world."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]

    def resized(self, width: int, height: int) -> Camera:
        """The camera with another pixel grid: K is scaled per axis."""
        scale = torch.tensor([width / self.width, height / self.height, 1.0], dtype=self.K.dtype)
        return replace(self, K=self.K * scale[:, None].to(self.K), width=width, height=height)


@dataclass(frozen=True)
class View:
    """A camera and its photo."""

    camera: Camera
    image: Tensor  # [H, W, 3] uint8 sRGB
    unrounded: Tensor | None = None  # [H, W, 3] in [0, 1]: the render itself, if the image is not a photo
    mask: Tensor | None = None  # [H, W] bool: False at ignored pixels

    def photo(self, device: torch.device) -> Tensor:
        """[H, W, 3] in [0, 1] the image."""
        return self.image.to(device).float() / 255


@dataclass(frozen=True)
class ViewOptions:
    """How views are read, or rendered for a scene that is a model; see `load_scene`."""

    width: int | None = None  # pixels; wider photos are shrunk
    background: tuple[float, ...] | None = None  # [3] in [0, 1]
    skip_missing: bool = False  # skip photos that do not exist or have no usable camera


@dataclass(frozen=True)
class Scene:
    """Posed images of one scene, split into training and test views, and its sparse points."""

    name: str
    train: tuple[View, ...]
    test: tuple[View, ...]
    points: Tensor  # [P, 3] float32 sparse reconstruction, may be empty
    colors: Tensor  # [P, 3] uint8 sRGB colours of the points
    background: Tensor = field(default_factory=lambda: torch.zeros(3))  # [3] in [0, 1]
    # [3] float64: origin of the scene's frame in the frame of its files.
    origin: Tensor = field(default_factory=lambda: torch.zeros(3, dtype=torch.float64))

    @property
    def views(self) -> tuple[View, ...]:
        """Training views, then test views."""
        return self.train + self.test

    @property
    def extent(self) -> float:
        """1.1 x the largest distance of a training camera from their mean (3DGS's `cameras_extent`).

        If all cameras are in one place, 1.1 x their median distance from the points: an extent of 0 would
        stop training.
        """
        cameras = [view.camera for view in self.train]
        positions = camera_positions(cameras)
        reach = float((positions - positions.mean(0)).norm(dim=1).max())
        if reach <= _ROUNDING * float(positions.norm(dim=1).max()):
            seen = self.points.double() if len(self.points) else focus_point(cameras)[None]
            reach = float((seen - positions[0].double()).norm(dim=1).median())
        return 1.1 * reach

    def to_scene_frame(self, model: Gaussians) -> Gaussians:
        """`model` in the scene's frame; it may be in this frame already, or in that of the scene's files."""
        if not self.origin.any():
            return model
        middle = model.means.detach().double().cpu().median(0).values
        if middle.norm() < (middle - self.origin).norm():
            return model
        means = model.means.double() - self.origin.to(model.device)
        return replace(model, means=means.to(model.means.dtype))

    def digest(self) -> str:
        """SHA-256 over all cameras, photos, points and the background: equal for equal content only."""
        state = hashlib.sha256(f"{len(self.train)} {len(self.test)}".encode())
        tensors = [self.points, self.colors, self.background]
        for view in self.views:
            tensors += [view.camera.viewmat, view.camera.K, view.image]
            tensors += [] if view.mask is None else [view.mask]
        for tensor in tensors:
            state.update(f"{tensor.dtype} {list(tensor.shape)}".encode())
            state.update(tensor.contiguous().numpy().tobytes())
        return state.hexdigest()


def camera_positions(cameras: Sequence[Camera]) -> Tensor:
    """[C, 3] centres of projection."""
    return torch.stack([camera.position for camera in cameras])


def camera_axes(cameras: Sequence[Camera], row: int) -> Tensor:
    """[C, 3] float64 unit vectors of one camera axis in the world: 0 right, 1 down, 2 forward."""
    return torch.stack([camera.viewmat[row, :3].double() for camera in cameras])


def focus_point(cameras: Sequence[Camera]) -> Tensor:
    """[3] float64 point nearest to all viewing axes, in the least-squares sense.

    If the axes are nearly parallel, or meet behind most cameras, the point lies in front of the mean camera,
    at the cameras' mean distance from it (1 if all are in one place). Raises ValueError without cameras.
    """
    if not cameras:
        raise ValueError("cameras: expected at least one, got none")
    positions, forward = camera_positions(cameras).double(), camera_axes(cameras, 2)
    mean = positions.mean(0)
    spread = float((positions - mean).norm(dim=1).mean())
    fallback = mean + forward.mean(0) * (spread if spread > 0 else 1.0)
    across = torch.eye(3, dtype=torch.float64) - forward[:, :, None] * forward[:, None, :]  # [C, 3, 3]
    normal = across.mean(0) + _FALLBACK_WEIGHT * torch.eye(3, dtype=torch.float64)
    target = torch.einsum("cij,cj->i", across, positions) / len(cameras) + _FALLBACK_WEIGHT * fallback
    focus = torch.linalg.solve(normal, target)
    depths = ((focus - positions) * forward).sum(1)
    return focus if 2 * int((depths > 0).sum()) >= len(cameras) else fallback


def checked_background(background: Tensor | Sequence[float]) -> Tensor:
    """A background colour as a tensor [3]. Raises UsageError if it is out of range."""
    values = [float(value) for value in background]
    if len(values) != 3 or not all(math.isfinite(v) and 0 <= v <= 1 for v in values):
        raise UsageError(f"expected a background of three numbers in [0, 1], got {values}")
    return torch.tensor(values, dtype=torch.float32)
