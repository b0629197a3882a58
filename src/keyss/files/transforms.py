"""Posed frames in `transforms*.json`, which the NeRF-synthetic and the Nerfstudio layout share."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from keyss.core.errors import InputError
from keyss.files.images import probe_image
from keyss.files.layout import MAX_COORDINATE, Photo, refuse_duplicates
from keyss.files.lens import Lens, make_lens
from keyss.files.reading import read_text

_MAX_JSON_BYTES = 256 * 2**20
_EXTENSIONS = (".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG", ".webp")
_PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
_COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2")


def read_transforms(path: Path) -> tuple[dict[str, Any], tuple[Photo, ...]]:
    """(the whole JSON object, its frames as photos in file order).

    A frame's own intrinsics go before those of the file. `file_path` is relative to the file's folder,
    may lack its extension, and must stay inside that folder or its parent. Raises InputError.
    """
    meta = read_json(path)
    frames = meta.get("frames")
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{path}: expected a list `frames` with at least one frame, found {_shown(frames)}")
    photos = []
    for i, frame in enumerate(frames):
        where = f"{path}: frame {i}"
        if not isinstance(frame, dict):
            raise InputError(f"{where}: expected an object, found {_shown(frame)}")
        name = inside(path, frame.get("file_path"))
        image = find_image(path.parent, name)
        viewmat = _viewmat(where, frame.get("transform_matrix"))
        photos.append(
            Photo(path.parent / image, image, viewmat, _lens(where, {**meta, **frame}, path.parent / image))
        )
    refuse_duplicates(path, photos)
    return meta, tuple(photos)


def read_json(path: Path) -> dict[str, Any]:
    """The JSON object in a file of up to 256 MiB. Raises InputError."""
    try:
        value = json.loads(read_text(path, _MAX_JSON_BYTES))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: expected JSON: {error}") from error
    if not isinstance(value, dict):
        raise InputError(f"{path}: expected a JSON object, found {_shown(value)}")
    return value


def inside(path: Path, file_path: object) -> str:
    """A path from a JSON file, normalised: relative to the file's folder, inside it or its parent."""
    if not isinstance(file_path, str) or not file_path or not file_path.isprintable():
        raise InputError(f"{path}: expected a relative `file_path`, found {_shown(file_path)}")
    name = os.path.normpath(file_path.replace("\\", "/")).replace(os.sep, "/")
    if (
        os.path.isabs(name)
        or ":" in name.split("/")[0]
        or name.split("/")[:2] == ["..", ".."]
        or name in (".", "..")
    ):
        raise InputError(
            f"{path}: expected paths in the scene's folder or its parent, found {file_path[:200]!r}"
        )
    return name


def find_image(folder: Path, name: str) -> str:
    """`name`, or `name` with the extension it lacks. Raises InputError when there is no such file."""
    for extension in ("", *_EXTENSIONS):
        if os.path.isfile(folder / (name + extension)):
            return name + extension
    raise InputError(
        f"{folder / name}: expected an image (the extension may be left out), but there is no such file"
    )


def _viewmat(where: str, matrix: object) -> NDArray[np.float64]:
    """[4, 4] world to camera in OpenCV axes from an OpenGL camera-to-world matrix."""
    rows = matrix if isinstance(matrix, list) else []
    if len(rows) not in (3, 4) or not all(isinstance(row, list) and len(row) == 4 for row in rows):
        raise InputError(f"{where}: expected a 4x4 `transform_matrix`, found {_shown(matrix)}")
    values = np.array([[_number(where, "transform_matrix", v) for v in row] for row in rows])
    if len(values) == 4 and not np.allclose(values[3], [0, 0, 0, 1], atol=1e-4):
        raise InputError(
            f"{where}: expected a `transform_matrix` that ends in 0 0 0 1, found {values[3].tolist()}"
        )
    rotation, position = values[:3, :3], values[:3, 3]
    if not (np.abs(values[:3]) <= MAX_COORDINATE).all():
        raise InputError(
            f"{where}: expected a finite `transform_matrix`, found values above {MAX_COORDINATE:g}"
        )
    scale = float(np.sqrt((rotation**2).sum() / 3))
    gram = rotation.T @ rotation / max(scale, 1e-12) ** 2
    if scale < 1e-9 or np.abs(gram - np.eye(3)).max() > 1e-2 or np.linalg.det(rotation / scale) < 0:
        raise InputError(f"{where}: expected a `transform_matrix` with a rotation, found {rotation.tolist()}")
    left, _, right = np.linalg.svd(rotation)
    opencv = (left @ right) * np.array([1.0, -1.0, -1.0])  # OpenGL looks along -z with y up
    viewmat = np.eye(4)
    viewmat[:3, :3] = opencv.T
    viewmat[:3, 3] = -opencv.T @ position
    return viewmat


def _lens(where: str, meta: dict[str, Any], image: Path) -> Lens:
    """The lens of one frame; `meta` holds its own keys over those of the file."""
    model = meta.get("camera_model", "OPENCV")
    fisheye = model == "OPENCV_FISHEYE" or meta.get("is_fisheye") is True
    if not fisheye and model not in _PERSPECTIVE:
        known = ", ".join((*_PERSPECTIVE, "OPENCV_FISHEYE"))
        raise InputError(f"{where}: camera_model {_shown(model)} is not supported (known: {known})")
    if "w" in meta and "h" in meta:
        width, height = (_whole(where, key, meta[key]) for key in ("w", "h"))
    else:
        width, height, _ = probe_image(image)
    fx = _focal(where, meta, "fl_x", "camera_angle_x", width)
    fy = _focal(where, meta, "fl_y", "camera_angle_y", height)
    if fx is None and fy is None:
        raise InputError(f"{where}: expected `fl_x` or `camera_angle_x`, found neither")
    values = {key: _number(where, key, meta[key]) for key in _COEFFICIENTS if key in meta}
    if not fisheye and values.pop("k4", 0.0) != 0.0:
        # Its meaning differs: Nerfstudio's is a 4th radial term, OpenCV's the first of a denominator.
        raise InputError(f"{where}: expected k4 = 0 for a lens that is not a fisheye, found {meta['k4']}")
    values["fx"] = fx if fx is not None else fy or 0.0
    values["fy"] = fy if fy is not None else fx or 0.0
    values["cx"] = _number(where, "cx", meta.get("cx", width / 2))
    values["cy"] = _number(where, "cy", meta.get("cy", height / 2))
    return make_lens(where, width, height, values, fisheye=fisheye)


def _focal(where: str, meta: dict[str, Any], focal: str, angle: str, side: int) -> float | None:
    if focal in meta:
        return _number(where, focal, meta[focal])
    if angle not in meta:
        return None
    radians = _number(where, angle, meta[angle])
    if not 0 < radians < math.pi:
        raise InputError(f"{where}: expected {angle} between 0 and pi, found {radians:g}")
    return side / 2 / math.tan(radians / 2)


def _number(where: str, key: str, value: object) -> float:
    """A finite JSON number."""
    try:
        number = float(value) if isinstance(value, int | float) and not isinstance(value, bool) else math.nan
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise InputError(f"{where}: expected a finite number as `{key}`, found {_shown(value)}")
    return number


def _whole(where: str, key: str, value: object) -> int:
    number = _number(where, key, value)
    if number != int(number):
        raise InputError(f"{where}: expected a whole number as `{key}`, found {_shown(value)}")
    return int(number)


def _shown(value: object) -> str:
    """A JSON value for an error message: short, or only its type."""
    if value is None:
        return "nothing"
    if isinstance(value, list | dict):
        return f"a {type(value).__name__} of {len(value)}"
    try:
        return repr(value)[:80]
    except ValueError:  # an integer of more digits than Python prints
        return f"a huge {type(value).__name__}"
