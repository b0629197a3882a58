"""Photos with poses, and points: what every scene layout is read into before photos are decoded."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
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
    mask: Path | None = None  # an image file, black where pixels are ignored


@dataclass(frozen=True)
class PointCloud:
    """Positions and sRGB colours."""

    xyz: Doubles  # [P, 3]
    rgb: Bytes  # [P, 3]

    @staticmethod
    def checked(where: Path, xyz: Doubles, rgb: Bytes) -> PointCloud:
        """Raises InputError if a coordinate is not finite or beyond 1e15."""
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
    """(train, test): every 8th photo by name is a test view, as for Mip-NeRF 360 and in 3DGS.

    Raises InputError for fewer than 2 photos.
    """
    if len(photos) < 2:
        raise InputError(
            f"{where}: expected at least 2 posed images, to train and to test, got {len(photos)}"
        )
    ordered = sorted(photos, key=lambda photo: photo.name)
    return tuple(p for i, p in enumerate(ordered) if i % 8), tuple(ordered[::8])


def leave_out(where: Path, total: int, why: str, photos: Sequence[str], skip_missing: bool) -> None:
    """Raise InputError if `photos`, some of `total`, cannot be used.

    With `skip_missing`, a KeyssWarning, unless these are all photos.
    """
    if not photos:
        return
    listed = ", ".join(photos[:5]) + (f" and {len(photos) - 5:,} more" if len(photos) > 5 else "")
    count = f"{where}: {len(photos):,} of {total:,} photos {why}"
    if len(photos) == total:
        raise InputError(f"{count}: {listed}")
    if not skip_missing:
        raise InputError(f"{count}: {listed}; `skip_missing=True` leaves them out")
    warnings.warn(f"{count}, left out: {listed}", KeyssWarning, stacklevel=2)


class CaseInsensitiveFinder:
    """Finds files whose names differ from those in a scene by case only."""

    def __init__(self) -> None:
        self._listings: dict[Path, dict[str, list[str]]] = {}

    def find(self, folder: Path, name: str) -> str:
        """`name`, relative to `folder`, as spelt on disk if exactly one path matches, else unchanged."""
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
        """The names in a folder by their case-folded form."""
        if folder not in self._listings:
            names: dict[str, list[str]] = {}
            for each in os.listdir(folder) if folder.is_dir() else ():
                names.setdefault(each.casefold(), []).append(each)
            self._listings[folder] = names
        return self._listings[folder]


def refuse_duplicates(where: Path, photos: Sequence[Photo]) -> None:
    """Raise InputError if two photos share a name: they could be in both training and test set."""
    seen: set[str] = set()
    for photo in photos:
        if photo.name in seen:
            raise InputError(f"{where}: expected every image once, found {photo.name!r} twice")
        seen.add(photo.name)
