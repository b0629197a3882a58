"""The initial view of the page: the model from the side of its photos."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import torch

from keyss.core.errors import InputError
from keyss.core.scene import Camera, camera_positions, focus_point
from keyss.core.similarity import up_direction
from keyss.files.images import probe_image
from keyss.files.scenes import read_layout
from keyss.runs.files import CONFIG, is_run

# Keys: `pose`, as in the page's address ("eye=X,Y,Z&target=X,Y,Z", and "&up=z" or "&up=X,Y,Z"); `camera`, a
# pose of the photos that sets side and tilt; `up`, an axis ("-y"); `background`, "#rrggbb"; `title`; `host`,
# an origin from which the page may load models and pictures; `embedder`, the origin of a site that frames the
# page and receives its events. The page chooses missing values.
Look = dict[str, str]


def look_of_model(model: Path) -> Look:
    """The look of the scene from which the model's run was made, empty if either is missing."""
    run = next((parent for parent in model.absolute().parents[:2] if is_run(parent)), None)
    try:
        config = json.loads((run / CONFIG).read_bytes()) if run else {}
        return look_of_scene(Path(config.get("cover") or config.get("scene") or ""))
    except (OSError, ValueError):
        return {}


def look_of_scene(scene: Path) -> Look:
    """A photo at the cameras' median height, in the middle of an arc; empty if the path is not a scene."""
    try:
        layout = read_layout(scene, skip_missing=True)
        is_white = probe_image(layout.train[0].path)[2]  # `load_scene` does the same
    except InputError:
        return {}
    poses = [torch.from_numpy(photo.viewmat.astype(np.float32)) for photo in layout.train]
    cameras = [Camera(pose, torch.eye(3), 1, 1, str(index)) for index, pose in enumerate(poses)]
    up = up_direction(cameras)
    up = -cameras[0].viewmat[1, :3] if up is None else up
    positions = camera_positions(cameras)
    heights = positions @ up.float()
    offsets = (heights - heights.median()).abs()
    distances = torch.cdist(positions, positions[:: len(positions) // 500 + 1]).sum(1)
    middle = cameras[int(distances.where(offsets <= offsets.median(), math.inf).argmin())]
    vectors = {"eye": middle.position, "target": focus_point(cameras), "up": up}
    texts = [f"{name}={','.join(f'{each:.6g}' for each in v.tolist())}" for name, v in vectors.items()]
    return {"camera": "&".join(texts), "background": "#ffffff" if is_white else "#000000"}
