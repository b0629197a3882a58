"""Reads COLMAP's layout: a sparse model (cameras, images, points; `.bin` or `.txt`) beside `images/`.

The reader is our own because pycolmap is a large package for three small files, and trusts them. Input is
untrusted: counts allocate nothing, only records that are there do, and nothing may follow the last record.
Format: https://colmap.github.io/format.html
"""

from __future__ import annotations

import io
import math
import os
import struct
import warnings
from array import array
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any, TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from keyss.core.arrays import Doubles, Numbers
from keyss.core.errors import InputError, KeyssWarning
from keyss.files.inputs import open_input, read_file, read_text
from keyss.files.lens import Lens, make_lens
from keyss.files.scene_layout import (
    MAX_COORDINATE,
    NO_POINTS,
    Finder,
    Photo,
    PointCloud,
    SceneLayout,
    hold_out,
    leave_out,
    refuse_duplicates,
)

# Folders of the sparse model in order of preference; the last is in Nerfstudio's scenes.
MODEL_PLACES = ("sparse/0", "sparse", ".", "colmap/sparse/0")
_MIN_IMAGE_BYTES = 73  # per image in images.bin
_IMAGE_LINE = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"  # in images.txt
_IMAGE_FOLDERS = ("images", "images_2", "images_4", "images_8")

_T = TypeVar("_T")
_Image = tuple[str, int, Sequence[float]]  # name, camera id, quaternion wxyz and translation

# Parameters in file order. Missing fisheye coefficients are zero.
_PARAMETERS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "SIMPLE_RADIAL_FISHEYE": "f cx cy k1",
    "RADIAL_FISHEYE": "f cx cy k1 k2",
}
# Ordered by the model id in cameras.bin.
_MODEL_NAMES = (
    *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV"),
    *("FOV", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE"),
    *("SIMPLE_DIVISION", "DIVISION", "SIMPLE_FISHEYE", "FISHEYE", "EUCM", "EQUIRECTANGULAR"),
)


def read_colmap(folder: Path, *, skip_missing: bool = False) -> SceneLayout:
    """The photos in `images/` with the poses and points of the sparse model; every 8th is a test view.

    If `images/` has no photos, the first of `images_2/`, `images_4/` and `images_8/` with photos is used.
    Points are sorted by id; without points there is a KeyssWarning. Files are `.bin` if `cameras.bin`
    exists, else `.txt`. Image names may have subfolders, and differ by case from those on disk.
    `skip_missing`: see `leave_out`. The mask of NAME.EXT is `masks/NAME.EXT.png`, as in COLMAP, or
    `masks/NAME.png`.

    Raises InputError for names that are absolute or contain `..`, and if a file is missing, truncated, too
    long, or has impossible values (NaN, zero quaternions, unknown cameras, absurd counts or sizes).
    """
    models = colmap_models(folder)
    if not models:
        raise InputError(f"{folder}: expected a COLMAP model (sparse/0/cameras.bin or .txt), found none")
    model = models[0]
    if len(models) > 1:
        warnings.warn(
            f"{folder}: there are {len(models)} sparse models; using the one with most photos, "
            f"{model.relative_to(folder)} ({_photo_count(model):,} photos)",
            KeyssWarning,
            stacklevel=2,
        )
    if (model / "cameras.bin").is_file():
        cameras, images = _cameras_bin(model / "cameras.bin"), _images_bin(model / "images.bin")
        points = _points(model / "points3D.bin", _points_bin)
    else:
        cameras, images = _cameras_txt(model / "cameras.txt"), _images_txt(model / "images.txt")
        points = _points(model / "points3D.txt", _points_txt)
    lenses: dict[int, Lens] = {}
    for camera_id, lens in cameras:
        if camera_id in lenses:
            raise InputError(f"{model}: expected every camera once, found id {camera_id} twice")
        lenses[camera_id] = lens
    photos, broken = [], []
    for name, camera_id, pose in images:
        where = f"image {name[:99]!r}"
        parsed = PureWindowsPath(name)  # splits at both kinds of slash and knows drives
        if not name.isprintable() or not parsed.parts or parsed.anchor or ".." in parsed.parts:
            raise InputError(f"{model}: expected image names inside images/, found {name[:99]!r}")
        if camera_id not in lenses:
            raise InputError(f"{model}: {where} refers to camera {camera_id}, which does not exist")
        try:
            viewmat = _viewmat(where, pose)
            photos.append(Photo(folder / name, name, viewmat, lenses[camera_id]))
        except InputError as error:
            broken.append(str(error))
    refuse_duplicates(model, (photo.name for photo in photos))
    leave_out(model, len(photos) + len(broken), "have no usable camera", broken, skip_missing)
    images_folder, existing = _find_images(folder, photos)
    missing = sorted({photo.name for photo in photos} - {photo.name for photo in existing})
    leave_out(folder / images_folder, len(photos), "are missing", missing, skip_missing)
    return SceneLayout(*hold_out(model, _with_masks(folder, existing)), points)


def colmap_models(folder: Path, places: Sequence[str] = MODEL_PLACES) -> list[Path]:
    """The sparse models in the first of `places` that has any, the one with most photos first.

    COLMAP writes several side by side, in numbered folders, if it cannot connect all photos.
    """
    for place in (folder / name for name in places):
        beside = place.parent.glob("[0-9]*") if place.parent.name == "sparse" else ()
        numbered = sorted(
            (entry for entry in beside if entry.name.isdecimal()), key=lambda entry: int(entry.name)
        )
        models = [
            model
            for model in numbered or [place]
            if any((model / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt"))
        ]
        if models:
            return sorted(models, key=_photo_count, reverse=True)
    return []


def _photo_count(model: Path) -> int:
    """Number of photos that a sparse model declares; 0 if it is damaged."""
    try:
        if (model / "cameras.bin").is_file():
            with open_input(model / "images.bin") as file:
                count = int.from_bytes(file.read(8), "little")
                return count if _MIN_IMAGE_BYTES * count <= file.seek(0, os.SEEK_END) else 0
        return sum(1 for _ in _rows(model / "images.txt", _IMAGE_LINE, lines=2))
    except InputError:
        return 0


def _find_images(folder: Path, photos: Sequence[Photo]) -> tuple[str, list[Photo]]:
    """(folder of images, the photos it contains)."""
    finder = Finder()
    for images in _IMAGE_FOLDERS:
        named = [(f"{images}/{photo.name}", photo) for photo in photos]
        matches = [(finder.find(folder, name), name, photo) for name, photo in named]
        spelt = {path: photo for path, _, photo in matches if path}
        spelt |= {path: photo for path, name, photo in matches if path == name}
        placed = {photo.name: replace(photo, path=folder / path) for path, photo in spelt.items() if path}
        if existing := [placed[photo.name] for photo in photos if photo.name in placed]:
            return images, existing
    return _IMAGE_FOLDERS[0], []


def _with_masks(folder: Path, photos: Sequence[Photo]) -> list[Photo]:
    """The photos with their masks, if any. Warns if no mask is named like a photo."""
    masks, finder, masked = folder / "masks", Finder(), []
    for photo in photos if masks.is_dir() else ():
        names = (f"{photo.name}.png", f"{PurePosixPath(photo.name).with_suffix('.png')}", photo.name)
        paths = (masks / spelt for name in names if (spelt := finder.find(masks, name)))
        masked.append(replace(photo, mask=next((path for path in paths if path.is_file()), None)))
    if masked and not any(photo.mask for photo in masked):
        warnings.warn(
            f"{masks}: no mask is used, since none is named like a photo: expected {photos[0].name}.png",
            KeyssWarning,
            stacklevel=3,
        )
    return masked or list(photos)


def _lens(where: str, model: str, width: int, height: int, read: Callable[[int], Sequence[float]]) -> Lens:
    """A lens by COLMAP's model name; `read` returns the given number of parameters."""
    if model not in _PARAMETERS:
        known = ", ".join(_PARAMETERS)
        raise InputError(
            f"{where}: camera model {model} is not supported (known: {known}); "
            "undistort the photos first with `colmap image_undistorter`"
        )
    names = _PARAMETERS[model].split()
    values = dict(zip(names, read(len(names)), strict=True))
    return make_lens(where, width, height, values, fisheye=model.endswith("FISHEYE"))


class _Records:
    """A bounds-checked cursor over a binary file. All methods raise InputError."""

    def __init__(self, path: Path) -> None:
        self.path, self.data, self.offset = path, read_file(path), 0

    def each(self, what: str) -> Iterator[int]:
        """Counts the records, which the caller takes; nothing may follow the last."""
        (count,) = self.take("<Q", f"the number of {what}")
        yield from range(count)
        if left := len(self.data) - self.offset:
            raise InputError(f"{self.path}: expected the end of the file, found {left} bytes more")

    def take(self, layout: str, what: str) -> tuple[Any, ...]:
        start = self.offset
        self.skip(struct.calcsize(layout), what)
        return struct.unpack_from(layout, self.data, start)

    def skip(self, size: int, what: str) -> None:
        if size > (left := len(self.data) - self.offset):
            raise InputError(
                f"{self.path}: expected {what} at byte {self.offset}, but only {left} bytes are left: "
                "the file is truncated or damaged"
            )
        self.offset += size

    def name(self) -> str:
        end = self.data.find(b"\0", self.offset, self.offset + 4096)
        if end < 0:
            raise InputError(f"{self.path}: expected an image name of up to 4095 bytes at byte {self.offset}")
        raw, self.offset = self.data[self.offset : end], end + 1
        try:
            return raw.decode()
        except UnicodeDecodeError as error:
            raise InputError(f"{self.path}: expected an image name in UTF-8, found {raw!r}") from error


def _viewmat(where: str, pose: Sequence[float]) -> Doubles:
    """[4, 4] from a quaternion wxyz of any length and a translation, both from world to camera."""
    *quaternion, x, y, z = pose
    if not 1e-8 < math.hypot(*quaternion) < math.inf:
        raise InputError(f"{where}: expected a rotation quaternion, found {quaternion}")
    if not all(abs(t) <= MAX_COORDINATE for t in (x, y, z)):
        raise InputError(f"{where}: expected a finite translation, found {[x, y, z]}")
    viewmat = np.eye(4)
    viewmat[:3, :3] = Rotation.from_quat(np.roll(quaternion, -1)).as_matrix()  # scipy's order is xyzw
    viewmat[:3, 3] = x, y, z
    return viewmat


def _cameras_bin(path: Path) -> Iterator[tuple[int, Lens]]:
    records = _Records(path)
    for _ in records.each("cameras"):
        camera_id, number, width, height = records.take("<IiQQ", "a camera")
        model = _MODEL_NAMES[number] if 0 <= number < len(_MODEL_NAMES) else f"number {number}"
        where = f"{path}: camera {camera_id}"
        yield camera_id, _lens(where, model, width, height, lambda n: records.take(f"<{n}d", "parameters"))


def _images_bin(path: Path) -> Iterator[_Image]:
    records = _Records(path)
    for _ in records.each("images"):
        _, *pose, camera_id = records.take("<I7dI", "an image")
        yield records.name(), camera_id, pose
        (observations,) = records.take("<Q", "the number of observations")
        records.skip(24 * observations, "observations")


def _points_bin(path: Path) -> PointCloud:
    records, offsets = _Records(path), []
    for _ in records.each("points"):
        offsets.append(records.offset)
        (track_length,) = records.take("<43xQ", "a point")
        records.skip(8 * track_length, "the images of a point")
    fields = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3)])
    starts = np.array(offsets, np.int64)[:, None]
    raw = np.frombuffer(records.data, dtype=np.uint8)[starts + np.arange(fields.itemsize)]
    points = raw.view(fields)[:, 0]
    return _sorted_points(path, points["id"], points["xyz"], points["rgb"])


def _points(path: Path, read: Callable[[Path], PointCloud]) -> PointCloud:
    points = read(path) if path.exists() else NO_POINTS
    if not len(points.xyz):
        warnings.warn(
            f"{path}: there are no points; a fit starts from random points around the focus of the cameras",
            KeyssWarning,
            stacklevel=2,
        )
    return points


def _sorted_points(path: Path, ids: Numbers, xyz: Numbers, rgb: Numbers) -> PointCloud:
    order = np.argsort(ids, kind="stable")
    return PointCloud.checked(path, xyz[order].astype(np.float64), rgb[order].astype(np.uint8))


def _cameras_txt(path: Path) -> Iterator[tuple[int, Lens]]:
    for where, words in _rows(path, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS..."):
        camera_id, width, height = (_number(int, where, words[i]) for i in (0, 2, 3))
        yield camera_id, _lens(where, words[1], width, height, partial(_floats, where, words[4:]))


def _images_txt(path: Path) -> Iterator[_Image]:
    for where, words in _rows(path, _IMAGE_LINE, lines=2):
        yield words[9], _number(int, where, words[8]), _floats(where, words[1:8], 7)


def _points_txt(path: Path) -> PointCloud:
    ids, xyz, rgb = array("Q"), array("d"), array("B")  # lists take five times as much memory
    for where, words in _rows(path, "POINT3D_ID X Y Z R G B ERROR TRACK..."):
        color = [_number(int, where, word) for word in words[4:7]]
        xyz.extend(_floats(where, words[1:4], 3))
        try:
            ids.append(_number(int, where, words[0]))
            rgb.extend(color)
        except OverflowError as error:
            raise InputError(f"{where}: expected an id, and colours of 0 to 255, found {color}") from error
    values = np.array(xyz).reshape(-1, 3), np.array(rgb).reshape(-1, 3)
    return _sorted_points(path, np.array(ids), *values)


def _rows(path: Path, layout: str, lines: int = 1) -> Iterator[tuple[str, list[str]]]:
    """(where, words) of the first of each record's `lines` lines, which has the given `layout`.

    The last word is the rest of the line, since image names may contain spaces; a layout that ends in `...`
    has any number of last words.
    """
    size = len(layout.split())
    is_open = layout.endswith("...")
    numbered = enumerate(io.StringIO(read_text(path), newline="\n"), 1)
    for number, line in numbered:
        if not line.strip() or line.startswith("#"):
            continue
        words = line.split() if is_open else line.strip().split(maxsplit=size - 1)
        if len(words) < size - is_open:
            raise InputError(f"{path}, line {number}: expected `{layout}`, found {line[:80]!r}")
        yield f"{path}, line {number}", words
        for _ in range(lines - 1):
            next(numbered, None)  # an image's observations; may be empty


def _number(kind: Callable[[str], _T], where: str, word: str) -> _T:
    try:
        return kind(word)
    except ValueError as error:
        name = getattr(kind, "__name__", kind)
        raise InputError(f"{where}: expected a number ({name}), found {word[:40]!r}") from error


def _floats(where: str, words: Sequence[str], count: int) -> list[float]:
    if len(words) != count:
        raise InputError(f"{where}: expected {count} numbers, found {len(words)}")
    return [_number(float, where, word) for word in words]
