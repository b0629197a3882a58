"""Alignment of one capture's world with another's frame, from the cameras alone."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from keyss.core.scene import Camera, camera_axes, camera_positions, focus_point
from keyss.core.similarity import Similarity

# A shorter mean of unit vectors is no direction: they point everywhere.
_MIN_UP = 0.1
_MIN_HEADING = 0.2


def align(secret_cameras: Sequence[Camera], cover_cameras: Sequence[Camera]) -> Similarity:
    """The similarity that moves the secret's world into the cover's frame.

    It maps the secret's focus point to the cover's, and makes the mean distances of the cameras from it and
    the up directions equal. The rotation about the up direction makes the mean headings equal if both
    captures have one (a half ring has, a full ring has not), and is as small as possible otherwise. Without
    an up direction, nothing is rotated.

    Raises ValueError when either set is empty.
    """
    secret, cover = _Capture.of(secret_cameras), _Capture.of(cover_cameras)
    scale = cover.distance / secret.distance
    rotation = _rotation(secret, cover)
    return Similarity(scale, rotation, cover.focus - scale * rotation @ secret.focus)


def up_direction(cameras: Sequence[Camera]) -> Tensor | None:
    """[3] float64 unit up direction of the world, None if the cameras do not agree on one.

    People hold cameras level but tilt them: the horizontal axes of the images span the horizontal plane of
    the world, while the mean of the cameras' up vectors leans forward by up to 20 degrees on a half ring.
    That mean is used only if the horizontal axes do not span a plane.
    """
    mean = camera_axes(cameras, 1).mean(0).neg()
    if float(mean.norm()) < _MIN_UP:
        return None
    right = camera_axes(cameras, 0)
    spread, axes = torch.linalg.eigh(right.T @ right / len(cameras))
    normal: Tensor = axes[:, 0] * torch.sign(axes[:, 0] @ mean)
    planar = bool(spread[1] > 0.05 and spread[0] < 0.2 * spread[1])
    if planar and float(normal @ mean) > 0.5 * float(mean.norm()):
        return normal
    return _unit(mean)


@dataclass(frozen=True)
class _Capture:
    """Focus and directions of a set of cameras, all float64."""

    focus: Tensor  # [3]
    distance: float  # mean from the cameras to the focus, positive
    up: Tensor | None  # [3] unit vector
    heading: Tensor | None  # [3] unit vector, mean viewing direction across `up`

    @staticmethod
    def of(cameras: Sequence[Camera]) -> _Capture:
        focus = focus_point(cameras)
        distance = float((camera_positions(cameras).double() - focus).norm(dim=1).mean())
        up = up_direction(cameras)
        heading = None
        if up is not None:
            forward = camera_axes(cameras, 2).mean(0)
            across = forward - up * (up @ forward)
            if float(across.norm()) > _MIN_HEADING:
                heading = _unit(across)
        return _Capture(focus, distance if distance > 0 else 1.0, up, heading)


def _rotation(secret: _Capture, cover: _Capture) -> Tensor:
    """[3, 3] float64 rotation that maps the secret's up direction to the cover's, and then aligns headings.

    The smallest such rotation if a capture has no heading; the identity if it has no up direction.
    """
    if secret.up is None or cover.up is None:
        return torch.eye(3, dtype=torch.float64)
    from scipy.spatial.transform import Rotation  # slow to load

    if secret.heading is None or cover.heading is None:
        rotation, _ = Rotation.align_vectors(cover.up[None], secret.up[None])
    else:
        targets, sources = torch.stack([cover.up, cover.heading]), torch.stack([secret.up, secret.heading])
        rotation, _ = Rotation.align_vectors(targets, sources, weights=[math.inf, 1])
    return torch.from_numpy(rotation.as_matrix())


def _unit(vector: Tensor) -> Tensor:
    return torch.nn.functional.normalize(vector, dim=0)
