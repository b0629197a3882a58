"""Paths of a camera for films: once around a model, or along the cameras of a scene."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation, Slerp

from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Camera
from keyss.rendering.orbit import FIELD_OF_VIEW, looking, middle_and_radius

ELEVATION = 20.0  # degrees
_DISTANCE = 0.8  # of that from which the whole model is seen


def circle(model: Gaussians, size: int, frames: int) -> list[Camera]:
    """Cameras on a level circle around what can be seen of a model, from a little above; up is -y.

    Pictures of size x size pixels; the last frame is a step before the first, so that the film can repeat.
    """
    middle, radius = middle_and_radius(model)
    focal = 0.5 * size / math.tan(math.radians(FIELD_OF_VIEW / 2))
    K = torch.tensor([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    reach = _DISTANCE * radius / math.sin(math.radians(FIELD_OF_VIEW / 2))
    height, flat = math.sin(math.radians(ELEVATION)), math.cos(math.radians(ELEVATION))
    cameras = []
    for index in range(frames):
        azimuth = 2 * math.pi * index / frames
        outward = torch.tensor([flat * math.cos(azimuth), -height, flat * math.sin(azimuth)])
        cameras.append(looking(middle + outward * reach, -outward, K, size, f"circle_{index:04d}.png"))
    return cameras


def along(cameras: Sequence[Camera], frames: int) -> list[Camera]:
    """The way through `cameras` by their names, from the first to the last at an even pace.

    Positions are interpolated linearly, rotations on the shortest way; lens and size are those of the first.
    Raises UsageError where there is none.
    """
    if not cameras:
        raise UsageError("expected a scene with cameras to film from, found none of them")
    ordered = sorted(cameras, key=lambda camera: camera.name)
    first = ordered[0]
    if len(ordered) == 1:
        return [first] * frames
    poses = np.stack([camera.viewmat.double().numpy() for camera in ordered])
    turns = Rotation.from_matrix(poses[:, :3, :3])
    places = np.stack([camera.position.double().numpy() for camera in ordered])
    stops, times = np.arange(len(ordered)), np.linspace(0, len(ordered) - 1, frames)
    rotations = Slerp(stops, turns)(times).as_matrix()
    positions = np.stack([np.interp(times, stops, places[:, axis]) for axis in range(3)], axis=1)
    found = []
    for index, (rotation, position) in enumerate(zip(rotations, positions, strict=True)):
        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ position
        pose = torch.from_numpy(viewmat).float()
        found.append(replace(first, viewmat=pose, name=f"path_{index:04d}.png"))
    return found
