"""Scenes in Nerfstudio's layout: one `transforms.json` (instant-ngp's files are read too)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from keyss.core.errors import InputError
from keyss.files.layout import Photo, PointCloud, SceneLayout, hold_out
from keyss.files.point_cloud import read_point_cloud
from keyss.files.transforms import find_image, inside, read_transforms


def read_nerfstudio(folder: Path) -> SceneLayout:
    """The photos, and the points of `ply_file_path` where it is given.

    `train_filenames` and `test_filenames` (or `val_filenames`) make the split; with only one of the two,
    the other photos are the other half; with neither, every 8th photo is for testing. Poses and points
    are both taken as stored: `applied_transform` says how they once were, and both have it. Raises
    InputError.
    """
    path = folder / "transforms.json"
    meta, photos = read_transforms(path)
    points = PointCloud.none()
    if meta.get("ply_file_path") is not None:
        points = read_point_cloud(folder / inside(path, meta["ply_file_path"]))
    return SceneLayout(*_split(path, meta, photos), points)


def _split(
    path: Path, meta: dict[str, Any], photos: tuple[Photo, ...]
) -> tuple[tuple[Photo, ...], tuple[Photo, ...]]:
    names = {photo.name for photo in photos}
    train = _listed(path, meta, "train_filenames", names)
    test = _listed(path, meta, "test_filenames", names) or _listed(path, meta, "val_filenames", names)
    if not train and not test:
        return hold_out(path, photos)
    train, test = train or names - test, test or names - train
    if both := train & test:
        raise InputError(f"{path}: expected training and test images apart, found {min(both)!r} in both")
    return tuple(p for p in photos if p.name in train), tuple(p for p in photos if p.name in test)


def _listed(path: Path, meta: dict[str, Any], key: str, names: set[str]) -> set[str]:
    """Those of the frames' `names` that the list `key` holds; none where there is no list."""
    paths = meta.get(key)
    if paths is None:
        return set()
    if not isinstance(paths, list):
        raise InputError(f"{path}: expected a list as `{key}`, found {type(paths).__name__}")
    listed = {find_image(path.parent, inside(path, each)) for each in paths}
    if unknown := listed - names:
        raise InputError(f"{path}: expected `{key}` to name frames, found {min(unknown)!r}, which is none")
    return listed
