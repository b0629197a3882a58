"""Scenes in the layout of NeRF-synthetic: `transforms_train.json` and `transforms_test.json`."""

from __future__ import annotations

from pathlib import Path

from keyss.files.layout import Photo, PointCloud, SceneLayout, hold_out, refuse_duplicates
from keyss.files.transforms import read_transforms


def read_blender(folder: Path) -> SceneLayout:
    """The photos of the training and the test file; there are no points.

    Without a test file the validation file takes its place, and without that every 8th training photo.
    Raises InputError, also when one photo is in both files.
    """
    _, train = read_transforms(folder / "transforms_train.json")
    test: tuple[Photo, ...] = ()
    for split in ("test", "val"):
        path = folder / f"transforms_{split}.json"
        if path.is_file():
            _, test = read_transforms(path)
            refuse_duplicates(path, train + test)
            break
    else:
        train, test = hold_out(folder, train)
    return SceneLayout(train, test, PointCloud.none())
