"""Scenes in COLMAP's layout: a sparse model beside a folder `images/`."""

from __future__ import annotations

from pathlib import Path, PureWindowsPath

from keyss.core.errors import InputError
from keyss.files.colmap_model import find_model, read_sparse_model
from keyss.files.layout import Photo, SceneLayout, hold_out, refuse_duplicates


def is_colmap(folder: Path) -> bool:
    """Whether the folder holds `cameras.bin` or `cameras.txt` in `sparse/0/`, `sparse/` or itself."""
    return find_model(folder) is not None


def read_colmap(folder: Path) -> SceneLayout:
    """The photos in `images/` with the poses and points of the sparse model; every 8th is for testing.

    Image names may hold subfolders but never leave `images/`. Raises InputError for a broken model and
    for names that are absolute or contain `..`; whether the photos exist is checked when they are read.
    """
    model_folder = find_model(folder)
    if model_folder is None:
        raise InputError(f"{folder}: expected a COLMAP model (sparse/0/cameras.bin or .txt), found none")
    model = read_sparse_model(model_folder)
    photos = [
        Photo(
            folder / "images" / _inside(model_folder, image.name),
            image.name,
            image.viewmat,
            model.lenses[image.camera_id],
        )
        for image in model.images
    ]
    refuse_duplicates(model_folder, photos)
    return SceneLayout(*hold_out(model_folder, photos), model.points)


def _inside(model_folder: Path, name: str) -> str:
    windows = PureWindowsPath(name)  # splits at both kinds of slash and knows drives
    if not name.isprintable() or not windows.parts or windows.anchor or ".." in windows.parts:
        raise InputError(f"{model_folder}: expected image names inside images/, found {name!r}")
    return name
