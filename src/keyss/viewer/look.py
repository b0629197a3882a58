"""The initial view of the page: the first test photo of the model's run."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np
import torch
from torch import Tensor

from keyss.core.errors import InputError
from keyss.core.scene import Camera, ViewOptions, camera_axes, camera_positions, focus_point
from keyss.core.similarity import up_direction
from keyss.files.images import probe_image, read_image
from keyss.files.scenes import origin_and_extent, plain_background, read_layout, recentre
from keyss.runs.files import CONFIG, is_run

# Keys: `pose`, as in the page's address ("eye=X,Y,Z&target=X,Y,Z", with "&up=z" or "&up=X,Y,Z", and
# "&fov=WIDTH,HEIGHT", degrees that the picture shows at least); `up`, an axis ("-y"); `background`,
# "#rrggbb"; `title`; `host`, an origin from which the page may load models and pictures; `embedder`, the
# origin of a site that frames the page and receives its events. The page chooses missing values.
Look = dict[str, str]

_FLAT = 0.2  # ratio of the two smallest eigenvalues of directions in a plane
_STEEP = 0.99  # cosine of a view straight up or down with the up direction
_WIDEST = 120.0  # degrees


def look_of_model(model: Path) -> Look:
    """The look of the scene from which the model's run was made, empty if either is missing."""
    run = next((parent for parent in model.absolute().parents[:2] if is_run(parent)), None)
    try:
        config = json.loads((run / CONFIG).read_bytes()) if run else {}
        views = msgspec.convert(config.get("views") or {}, ViewOptions)
        return look_of_scene(Path(config.get("cover") or config.get("scene") or ""), views.background)
    except (OSError, ValueError):
        return {}


def look_of_scene(scene: Path, background: Sequence[float] | None = None) -> Look:
    """The first test photo, whole and upright; empty if the path is not a scene.

    `background`: [3] in [0, 1], by default that of the photo.
    """
    try:
        layout = read_layout(scene, skip_missing=True)
        photo = sorted(layout.test or layout.train, key=lambda photo: photo.name)[0]
        width, height, is_transparent = probe_image(photo.path)
        if background is None and not is_transparent:
            pixels = read_image(photo.path, np.zeros(3, np.float32))
            background = plain_background([(torch.from_numpy(pixels), None)]).tolist()
    except InputError:
        return {}
    lens = photo.lens.scale_to(width, height) or photo.lens
    origin, _ = origin_and_extent([photo.viewmat for photo in layout.train])
    shown, *cameras = (
        Camera(
            torch.from_numpy(recentre(view.viewmat, origin)),
            torch.from_numpy(lens.K),
            width,
            height,
            view.name,
        )
        for view in (photo, *layout.train)
    )
    colour = "".join(f"{round(255 * value):02x}" for value in background or (1, 1, 1))
    return {"pose": pose_of(shown, cameras), "background": f"#{colour}"}


def pose_of(camera: Camera, cameras: Sequence[Camera]) -> str:
    """The pose of the page that shows all of a photo; it turns around what the `cameras` look at."""
    forward = camera.viewmat[2, :3].double()
    depth = float((focus_point(cameras) - camera.position) @ forward)
    distances = (camera_positions(cameras) - camera.position).norm(dim=1)
    depth = depth if depth > 0 else float(distances.max().clamp_min(1.0))
    up = _upright(cameras)
    up = -camera.viewmat[1, :3].double() if up is None or abs(float(up @ forward)) > _STEEP else up
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, up), dim=0)
    axes = torch.stack([right, torch.linalg.cross(forward, right), forward])
    pixels = [[x, y, 1.0] for x in (0, camera.width) for y in (0, camera.height)]
    corners = torch.tensor(pixels).double() @ torch.linalg.inv(camera.K.double()).T
    seen = corners @ camera.viewmat[:3, :3].double() @ axes.T  # [4, 3] in the axes of the page's camera
    width, height = (seen[:, :2].abs() / seen[:, 2:].clamp_min(1e-3)).amax(0).atan().rad2deg().mul(2).tolist()
    vectors = {"eye": camera.position, "target": camera.position + depth * forward, "up": up}
    texts = [f"{name}={','.join(f'{number:.6g}' for number in v.tolist())}" for name, v in vectors.items()]
    return "&".join([*texts, f"fov={min(width, _WIDEST):.4g},{min(height, _WIDEST):.4g}"])


def _upright(cameras: Sequence[Camera]) -> Tensor | None:
    """[3] float64 up direction of the world, also of photos that all lie on their side; None if unknown.

    Level cameras have an axis, x or in turned photos y, that stays across the up direction all around. In
    turned photos its sign is unknown: cameras look down rather than up.
    """
    right, down = (_flatness(camera_axes(cameras, row)) for row in (0, 1))
    if down[0] < _FLAT and right[0] > 2 * down[0]:
        forward = camera_axes(cameras, 2).mean(0)
        return -down[1] if float(down[1] @ forward) > 0 else down[1]
    return up_direction(cameras)


def _flatness(axes: Tensor) -> tuple[float, Tensor]:
    """How far [C, 3] unit vectors are from spanning a plane, 0 to 1, and its normal; 1 if they span less."""
    spread, basis = torch.linalg.eigh(axes.T @ axes / len(axes))
    return (float(spread[0] / spread[1]) if spread[1] > 0.05 else 1.0), basis[:, 0]
