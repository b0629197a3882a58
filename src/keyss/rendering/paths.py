"""Camera paths for videos: around a model, or around the focus of a scene."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from keyss.core.alignment import up_direction
from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Camera, camera_positions, focus_point
from keyss.rendering.orbit import FIELD_OF_VIEW, look_at, looking, middle_and_radius

ELEVATION = 20.0  # degrees
_GAP = math.pi / 2  # a larger gap between cameras makes a path turn back
_DISTANCE = 0.8  # relative to that from which the whole model is visible


def circle(model: Gaussians, size: int, frames: int) -> list[Camera]:
    """Cameras on a level circle around the visible part of a model, from slightly above; up is -y.

    Images of size x size pixels; the last frame is one step before the first, so that the video loops.
    """
    middle, radius = middle_and_radius(model)
    reach = _DISTANCE * radius / math.sin(math.radians(FIELD_OF_VIEW / 2))
    height, flat = math.sin(math.radians(ELEVATION)), math.cos(math.radians(ELEVATION))
    cameras = []
    for index in range(frames):
        azimuth = 2 * math.pi * index / frames
        outward = torch.tensor([flat * math.cos(azimuth), -height, flat * math.sin(azimuth)])
        cameras.append(looking(middle + outward * reach, -outward, size, f"circle_{index:04d}.png"))
    return cameras


def around(cameras: Sequence[Camera], frames: int) -> list[Camera]:
    """A level circle around the focus of `cameras`, at their median distance and height, with their up.

    If they leave a gap of a quarter or more, as in front of a wall, the path sways between the ends of the
    photographed arc instead. Lens and size are those of the first camera by name. Raises UsageError if there
    are no cameras.
    """
    if not cameras:
        raise UsageError("expected a scene with cameras, found none")
    first = min(cameras, key=lambda camera: camera.name)
    middle, up = focus_point(cameras), up_direction(cameras)
    if up is None:
        up = -first.viewmat[1, :3].double()
    offsets = camera_positions(cameras).double() - middle
    heights = offsets @ up
    flat = offsets - heights[:, None] * up
    forward = torch.nn.functional.normalize(flat[flat.norm(dim=1).argmax()], dim=0)
    sideways = torch.linalg.cross(up, forward)
    reach, height = float(flat.norm(dim=1).median()), float(heights.median())
    found = []
    for index, angle in enumerate(_angles(torch.atan2(flat @ sideways, flat @ forward), frames)):
        outward = reach * (math.cos(angle) * forward + math.sin(angle) * sideways) + height * up
        pose = look_at(middle + outward, torch.nn.functional.normalize(-outward, dim=0), up).float()
        found.append(replace(first, viewmat=pose, name=f"around_{index:04d}.png"))
    return found


def _angles(seen: Tensor, frames: int) -> list[float]:
    """Angles around the full circle, or to and fro on the arc of the cameras' angles `seen`."""
    ordered = seen.sort().values
    gaps = torch.cat([ordered[1:] - ordered[:-1], ordered[:1] + 2 * math.pi - ordered[-1:]])
    widest = int(gaps.argmax())
    start = float(ordered[(widest + 1) % len(ordered)])
    if float(gaps[widest]) < _GAP:
        return [start + 2 * math.pi * index / frames for index in range(frames)]
    arc = 2 * math.pi - float(gaps[widest])
    return [start + arc * (0.5 - 0.5 * math.cos(2 * math.pi * index / frames)) for index in range(frames)]
