"""Scenes in Nerfstudio's layout: one `transforms.json` (instant-ngp's files are read too)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from keyss.core.errors import InputError
from keyss.files.layout import Photo, PointCloud, SceneLayout, hold_out
from keyss.files.point_cloud import read_point_cloud
from keyss.files.transforms import find_image, inside, read_transforms


def is_nerfstudio(folder: Path) -> bool:
    """Whether the folder holds `transforms.json`."""
    return (folder / "transforms.json").is_file()


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
    train = _listed(path, meta, "train_filenames", photos)
    test = _listed(path, meta, "test_filenames", photos) or _listed(path, meta, "val_filenames", photos)
    if not train and not test:
        return hold_out(path, photos)
    train = train or _without(photos, test)
    test = test or _without(photos, train)
    both = {photo.name for photo in train} & {photo.name for photo in test}
    if both:
        raise InputError(f"{path}: expected training and test images apart, found {min(both)!r} in both")
    return train, test


def _without(photos: tuple[Photo, ...], others: tuple[Photo, ...]) -> tuple[Photo, ...]:
    names = {photo.name for photo in others}
    return tuple(photo for photo in photos if photo.name not in names)


def _listed(path: Path, meta: dict[str, Any], key: str, photos: tuple[Photo, ...]) -> tuple[Photo, ...]:
    names = meta.get(key)
    if names is None:
        return ()
    if not isinstance(names, list):
        raise InputError(f"{path}: expected a list as `{key}`, found {type(names).__name__}")
    by_name = {photo.name: photo for photo in photos}
    listed = {find_image(path.parent, inside(path, name)) for name in names}
    unknown = listed - by_name.keys()
    if unknown:
        raise InputError(f"{path}: expected `{key}` to name frames, found {min(unknown)!r}, which is none")
    return tuple(photo for photo in photos if photo.name in listed)
