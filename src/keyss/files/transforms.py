"""Reads the layouts of NeRF-synthetic and Nerfstudio: posed frames in JSON."""

from __future__ import annotations

import json
import math
import os
import warnings
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from keyss.core.arrays import Doubles
from keyss.core.errors import InputError, KeyssWarning
from keyss.files.images import probe_image
from keyss.files.inputs import open_input, read_text
from keyss.files.lens import Lens, make_lens
from keyss.files.ply_table import columns, read_vertices
from keyss.files.scene_layout import (
    MAX_COORDINATE,
    Finder,
    Photo,
    PointCloud,
    SceneLayout,
    hold_out,
    leave_out,
    refuse_duplicates,
)

_MAX_JSON_BYTES = 256 * 2**20
_MAX_PATH = 4096  # characters
_EXTENSIONS = (".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG", ".webp")
_PERSPECTIVE = ("OPENCV", "FULL_OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
_RGB, _GREY = ("red", "green", "blue"), 128  # the colour of points without any
_COEFFICIENTS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")

_Row = tuple[float, float, float, float]
_Matrix = Annotated[list[_Row], msgspec.Meta(min_length=3, max_length=4)]


class _Intrinsics(msgspec.Struct):
    """Intrinsics of all frames or of one frame, in pixels and radians."""

    camera_model: str | None = None
    is_fisheye: bool | None = None
    w: float | None = None
    h: float | None = None
    fl_x: float | None = None
    fl_y: float | None = None
    camera_angle_x: float | None = None
    camera_angle_y: float | None = None
    cx: float | None = None
    cy: float | None = None
    k1: float | None = None
    k2: float | None = None
    k3: float | None = None
    k4: float | None = None
    k5: float | None = None
    k6: float | None = None
    p1: float | None = None
    p2: float | None = None


class _Frame(_Intrinsics, kw_only=True):
    file_path: str
    transform_matrix: Any = None  # checked separately, so that errors name the photo
    mask_path: str | None = None


class _Transforms(_Intrinsics, kw_only=True):
    frames: list[_Frame]
    ply_file_path: str | None = None
    train_filenames: list[str] | None = None
    test_filenames: list[str] | None = None
    val_filenames: list[str] | None = None


def read_blender(folder: Path, *, skip_missing: bool = False) -> SceneLayout:
    """The photos of `transforms_train.json` and `transforms_test.json`, without points.

    Without a test file, test views come from the validation file, else they are every 8th training photo.
    `skip_missing`: see `leave_out`. Raises InputError, also if a photo is in both files.
    """
    _, train = _read(folder / "transforms_train.json", skip_missing)
    for split in ("test", "val"):
        path = folder / f"transforms_{split}.json"
        if path.is_file():
            _, test = _read(path, skip_missing)
            refuse_duplicates(path, (photo.name for photo in train + test))
            return SceneLayout(train, test)
    return SceneLayout(*hold_out(folder, train))


def read_nerfstudio(folder: Path, *, skip_missing: bool = False) -> SceneLayout:
    """The photos of a `transforms.json` (instant-ngp's too), and the points of its `ply_file_path`, if any.

    `train_filenames` and `test_filenames` (or `val_filenames`) define the split; with only one of them, the
    other photos are the other part. Without them, or with a KeyssWarning if `train_filenames` has all photos,
    every 8th photo is a test view. `skip_missing`: see `leave_out`. Poses and points are used as stored,
    since `applied_transform` was applied to both. Raises InputError.
    """
    path = folder / "transforms.json"
    meta, photos = _read(path, skip_missing)
    train, test = _split(path, meta, photos)
    if meta.ply_file_path is None:
        return SceneLayout(train, test)
    return SceneLayout(
        train, test, read_point_cloud(folder / _relative_path(path, meta.ply_file_path, Finder()))
    )


def read_point_cloud(path: Path) -> PointCloud:
    """The points of a PLY with `x y z` and, optionally, `red green blue` (uchar), else grey.

    Raises InputError if the file is not such a PLY, is truncated or holds coordinates that are not finite.
    """
    with open_input(path) as file:
        vertices = read_vertices(file)
        names = vertices.dtype.names or ()
        if missing := {"x", "y", "z"} - set(names):
            raise InputError(f"expected vertices with x, y and z, found no {sorted(missing)}")
        colors = {name: str(vertices.dtype[name]) for name in _RGB if name in names}
        if list(colors.values()) not in ([], ["uint8"] * 3):
            raise InputError(f"expected red, green and blue of type uchar, found {colors}")
        xyz, rgb = [np.empty((0, 3))], [np.empty((0, 3), np.uint8)]
        for table in vertices.blocks:
            xyz.append(columns(table, ("x", "y", "z"), np.float64))
            rgb.append(columns(table, _RGB, np.uint8) if colors else np.full_like(xyz[-1], _GREY, np.uint8))
    return PointCloud.checked(path, np.concatenate(xyz), np.concatenate(rgb))


def _read(path: Path, skip_missing: bool) -> tuple[_Transforms, tuple[Photo, ...]]:
    """A JSON file, and the photos of its frames that can be used.

    A frame's intrinsics override those of the file. `file_path` is relative to the file's folder, may lack
    its extension, and must stay inside that folder or its parent. Raises InputError.
    """
    try:
        # Parsed by json because msgspec refuses NaN and Infinity, which Python writes, and integers beyond
        # float64, which become infinite here.
        text = read_text(path, _MAX_JSON_BYTES)
        meta = msgspec.convert(json.loads(text, parse_int=_parse_int), type=_Transforms)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: expected JSON with posed frames: {error}") from error
    if not meta.frames:
        raise InputError(f"{path}: expected posed frames, found none")
    finder = Finder()
    names = [_image_name(path, frame.file_path, finder) for frame in meta.frames]
    missing = {name for name in names if not (path.parent / name).exists()}
    leave_out(path, len(names), "are missing", sorted(missing), skip_missing)
    refuse_duplicates(path, (name for name in names if name not in missing))
    photos, broken = [], []
    for i, (name, frame) in enumerate(zip(names, meta.frames, strict=True)):
        if name in missing:
            continue
        where = f"frame {i} ({name})"
        try:
            viewmat = _viewmat(where, _matrix(where, frame.transform_matrix))
            lens = _lens(where, meta, frame, path.parent / name)
            mask = None
            if frame.mask_path:
                spelt = _relative_path(path, frame.mask_path, finder)
                mask = path.parent / (finder.find(path.parent, spelt) or spelt)
            photos.append(Photo(path.parent / name, name, viewmat, lens, mask))
        except InputError as error:
            broken.append(str(error))
    leave_out(path, len(photos) + len(broken), "have no usable camera", broken, skip_missing)
    return meta, tuple(photos)


def _parse_int(digits: str) -> int | float:
    return int(digits) if len(digits) < 19 else float(digits)


def _split(
    path: Path, meta: _Transforms, photos: tuple[Photo, ...]
) -> tuple[tuple[Photo, ...], tuple[Photo, ...]]:
    """(train, test) by the lists of a JSON file, else every 8th photo."""
    finder = Finder()
    spelt = {frame.file_path: _image_name(path, frame.file_path, finder) for frame in meta.frames}
    names = set(spelt.values())

    def listed(paths: list[str] | None) -> set[str]:
        seen = set()
        for listed_path in paths or ():
            seen.add(name := spelt.get(listed_path) or _image_name(path, listed_path, finder))
            if name not in names:
                raise InputError(
                    f"{path}: expected lists of frames, found {name[:99]!r}, which is not a frame"
                )
        return seen

    train, test = listed(meta.train_filenames), listed(meta.test_filenames or meta.val_filenames)
    if train == names and not test:
        warnings.warn(
            f"{path}: `train_filenames` has all photos; every 8th of them becomes a test view",
            KeyssWarning,
            stacklevel=2,
        )
        train = set()
    if not train and not test:
        return hold_out(path, photos)
    train, test = train or names - test, test or names - train
    if both := train & test:
        raise InputError(f"{path}: expected training and test images apart, found {min(both)!r} in both")
    return tuple(p for p in photos if p.name in train), tuple(p for p in photos if p.name in test)


def _relative_path(path: Path, file_path: str, finder: Finder) -> str:
    """A path in a JSON file, normalised, relative to the file's folder, and inside it or its parent.

    For an absolute path, which may be from another computer, the longest suffix that exists in the folder.
    """
    name = os.path.normpath(file_path.replace("\\", "/")).replace(os.sep, "/")
    parts = name.split("/")
    if len(file_path) <= _MAX_PATH and (os.path.isabs(name) or ":" in parts[0]):
        name = finder.find_end(path.parent, parts) or name
        parts = name.split("/")
    outside = os.path.isabs(name) or ":" in parts[0] or parts[:2] == ["..", ".."] or name in (".", "..")
    if outside or len(file_path) > _MAX_PATH or not file_path.isprintable():
        raise InputError(
            f"{path}: expected paths in the scene's folder or its parent, found {file_path[:99]!r}"
        )
    return name


def _image_name(path: Path, file_path: str, finder: Finder) -> str:
    """The name of an image as spelt on disk, with its extension added if necessary."""
    name = _relative_path(path, file_path, finder)
    names = (finder.find(path.parent, name + extension) for extension in ("", *_EXTENSIONS))
    return next(
        (candidate for candidate in names if candidate and os.path.isfile(path.parent / candidate)), name
    )


def _matrix(where: str, values: object) -> Doubles:
    """[3 or 4, 4]. Raises InputError."""
    try:
        return np.array(msgspec.convert(values, type=_Matrix))
    except msgspec.ValidationError as error:
        raise InputError(
            f"{where}: expected a `transform_matrix` of 3 or 4 rows of 4 numbers: {error}"
        ) from error


def _viewmat(where: str, values: Doubles) -> Doubles:
    """[4, 4] world to camera in OpenCV axes from an OpenGL camera-to-world matrix [3 or 4, 4]."""
    if len(values) == 4 and not np.allclose(values[3], [0, 0, 0, 1], atol=1e-4):
        raise InputError(f"{where}: expected a `transform_matrix` that ends in 0 0 0 1, found {values[3]}")
    rotation, position = values[:3, :3], values[:3, 3]
    if not (np.abs(values[:3]) <= MAX_COORDINATE).all():
        raise InputError(
            f"{where}: expected a finite `transform_matrix`, found NaN or over {MAX_COORDINATE:g}"
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


def _lens(where: str, file: _Intrinsics, frame: _Intrinsics, image: Path) -> Lens:
    meta: dict[str, Any] = {
        name: value
        for given in (file, frame)
        for name in _Intrinsics.__struct_fields__
        if (value := getattr(given, name)) is not None
    }
    model = meta.get("camera_model", "OPENCV")
    fisheye = model == "OPENCV_FISHEYE" or meta.get("is_fisheye", False)
    if not fisheye and model not in _PERSPECTIVE:
        known = ", ".join((*_PERSPECTIVE, "OPENCV_FISHEYE"))
        raise InputError(f"{where}: camera_model {model[:80]!r} is not supported (known: {known})")
    if "w" in meta and "h" in meta:
        if not (float(meta["w"]).is_integer() and float(meta["h"]).is_integer()):
            raise InputError(
                f"{where}: expected whole numbers as `w` and `h`, found {meta['w']:g}, {meta['h']:g}"
            )
        width, height = int(meta["w"]), int(meta["h"])
    else:
        width, height, _ = probe_image(image)
    fx = _focal(where, meta, "fl_x", "camera_angle_x", width)
    fy = _focal(where, meta, "fl_y", "camera_angle_y", height)
    if fx is None and fy is None:
        raise InputError(f"{where}: expected `fl_x` or `camera_angle_x`, found neither")
    values = {key: meta[key] for key in _COEFFICIENTS if key in meta}
    rational = model == "FULL_OPENCV" or values.get("k5", 0.0) != 0.0 or values.get("k6", 0.0) != 0.0
    if not fisheye and not rational and values.pop("k4", 0.0) != 0.0:
        # In Nerfstudio a 4th radial term, in OpenCV the first term of a denominator.
        raise InputError(f"{where}: expected k4 = 0 for a lens that is not a fisheye, found {meta['k4']}")
    values["fx"], values["fy"] = fx if fx is not None else fy, fy if fy is not None else fx
    values["cx"], values["cy"] = meta.get("cx", width / 2), meta.get("cy", height / 2)
    return make_lens(where, width, height, values, fisheye=fisheye)


def _focal(where: str, meta: dict[str, Any], focal: str, angle: str, side: int) -> float | None:
    radians = meta.get(angle)
    if focal in meta or radians is None:
        return meta.get(focal)
    if not 0 < radians < math.pi:
        raise InputError(f"{where}: expected {angle} between 0 and pi, found {radians:g}")
    return float(side / 2 / math.tan(radians / 2))
