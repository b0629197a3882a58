"""Scenes before their photos are decoded: the result of reading any scene layout."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from keyss.core.arrays import Bytes, Doubles
from keyss.core.errors import InputError, KeyssWarning
from keyss.files.lens import Lens

MAX_COORDINATE = 1e15  # its square fits into float32


@dataclass(frozen=True)
class Photo:
    """An image file with its pose and lens."""

    path: Path
    name: str
    viewmat: Doubles  # [4, 4] world to camera, OpenCV axes, a rigid motion
    lens: Lens
    mask: Path | None = None  # an image file, black where the photo does not count


@dataclass(frozen=True)
class PointCloud:
    """Positions and sRGB colours."""

    xyz: Doubles  # [P, 3]
    rgb: Bytes  # [P, 3]

    @staticmethod
    def checked(where: Path, xyz: Doubles, rgb: Bytes) -> PointCloud:
        """The points. Raises InputError if a coordinate is not finite or beyond 1e15."""
        bad = ~(np.abs(xyz) <= MAX_COORDINATE).all(axis=1)
        if bad.any():
            first = int(bad.argmax())
            raise InputError(f"{where}: expected finite points, found {xyz[first]} as point {first + 1}")
        return PointCloud(xyz, rgb)


NO_POINTS = PointCloud(np.zeros((0, 3)), np.zeros((0, 3), np.uint8))


@dataclass(frozen=True)
class SceneLayout:
    """The photos of a scene, split into training and test, and its points."""

    train: tuple[Photo, ...]
    test: tuple[Photo, ...]
    points: PointCloud = NO_POINTS


def hold_out(where: Path, photos: Sequence[Photo]) -> tuple[tuple[Photo, ...], tuple[Photo, ...]]:
    """(train, test): every 8th photo by name, starting with the first, is a test view.

    This is the split of Mip-NeRF 360 and of 3DGS. Raises InputError for fewer than 2 photos.
    """
    if len(photos) < 2:
        raise InputError(
            f"{where}: expected at least 2 posed images, to train and to test, got {len(photos)}"
        )
    ordered = sorted(photos, key=lambda photo: photo.name)
    return tuple(p for i, p in enumerate(ordered) if i % 8), tuple(ordered[::8])


def leave_out_missing(where: Path, total: int, missing: Sequence[str], skip_missing: bool) -> None:
    """Raise InputError if photos of a scene are missing, or, with `skip_missing`, warn (KeyssWarning).

    `total` is the number of photos with the missing ones. If all are missing, InputError is raised anyway.
    """
    if not missing:
        return
    listed = ", ".join(missing[:5]) + (f" and {len(missing) - 5:,} more" if len(missing) > 5 else "")
    count = f"{len(missing):,} of {total:,} photos"
    if not skip_missing:
        raise InputError(f"{where}: {count} are missing: {listed}; `skip_missing=True` leaves them out")
    if len(missing) == total:
        raise InputError(f"{where}: all of its {total:,} photos are missing: {listed}")
    warnings.warn(f"{where}: {count} are missing and left out: {listed}", KeyssWarning, stacklevel=2)


def leave_out_broken(where: Path, total: int, broken: Mapping[str, str], skip_missing: bool) -> None:
    """`leave_out_missing` for photos without a usable camera; `broken` has messages by name of the photo."""
    if not broken:
        return
    first = next(iter(broken.values()))
    if len(broken) == total:
        raise InputError(first)
    count = f"{len(broken):,} of {total:,} photos"
    if not skip_missing:
        raise InputError(f"{first}; `skip_missing=True` leaves out such photos ({count})")
    listed = ", ".join(list(broken)[:5]) + (f" and {len(broken) - 5:,} more" if len(broken) > 5 else "")
    warnings.warn(
        f"{where}: {count} have no usable camera and are left out: {listed}", KeyssWarning, stacklevel=2
    )


class FileFinder:
    """Finds files whose names have another case than those that a scene lists."""

    def __init__(self) -> None:
        self._listings: dict[Path, dict[str, list[str]]] = {}

    def find(self, folder: Path, name: str) -> str:
        """`name`, relative to `folder`, as it is spelt on disk, if exactly one path matches; else `name`."""
        if (folder / name).exists():
            return name
        found: list[str] = []
        for part in name.split("/"):
            here = folder.joinpath(*found)
            alike = [part] if (here / part).exists() else self._listing(here).get(part.casefold(), [])
            if len(alike) != 1:
                return name
            found.append(alike[0])
        return "/".join(found)

    def _listing(self, folder: Path) -> dict[str, list[str]]:
        """The names in a folder by their spelling without case."""
        if folder not in self._listings:
            names: dict[str, list[str]] = {}
            for each in os.listdir(folder) if folder.is_dir() else ():
                names.setdefault(each.casefold(), []).append(each)
            self._listings[folder] = names
        return self._listings[folder]


def refuse_duplicates(where: Path, photos: Sequence[Photo]) -> None:
    """Raise InputError if two photos have one name: they could be in training and test set at once."""
    seen: set[str] = set()
    for photo in photos:
        if photo.name in seen:
            raise InputError(f"{where}: expected every image once, found {photo.name!r} twice")
        seen.add(photo.name)
