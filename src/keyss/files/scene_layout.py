"""Photos with poses, and points: what every scene layout is read into before photos are decoded."""

from __future__ import annotations

import os
import unicodedata
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from keyss.core.arrays import Bytes, Doubles
from keyss.core.errors import InputError, KeyssWarning
from keyss.files.lens import Lens

_SHOWN = 200  # characters of a name in messages
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
    listed = ", ".join(photo[:_SHOWN] for photo in photos[:5]) + (
        f" and {len(photos) - 5:,} more" if len(photos) > 5 else ""
    )
    count = f"{where}: {len(photos):,} of {total:,} photos {why}"
    if len(photos) == total:
        raise InputError(f"{count}: {listed}")
    if not skip_missing:
        raise InputError(f"{count}: {listed}; `skip_missing=True` leaves them out")
    warnings.warn(f"{count}, left out: {listed}", KeyssWarning, stacklevel=2)


class Finder:
    """Finds the files of a scene by name, or by the one name that differs by case only.

    Lists each folder once: a scene may name ten thousands of files that do not exist.
    """

    def __init__(self) -> None:
        self._listings: dict[str, dict[str, list[str]]] = {}

    def find(self, folder: Path, name: str) -> str | None:
        """`name`, relative to `folder`, as spelt on disk; None if it does not exist."""
        return self._find(folder, name.replace(os.sep, "/").split("/"))

    def find_end(self, folder: Path, parts: Sequence[str]) -> str | None:
        """The longest end of a path, in parts, that exists in `folder`; not all of it."""
        ends = (range(start, len(parts)) for start in range(1, len(parts)))
        paths = (self._find(folder, (parts[index] for index in end)) for end in ends)
        return next(filter(None, paths), None)

    def _find(self, folder: Path, parts: Iterable[str]) -> str | None:
        here, matches = os.fspath(folder), []
        for part in parts:
            if part in ("", "."):
                continue
            alike = [part] if part == ".." else self._listing(here).get(_folded(part), [])
            if part not in alike and len(alike) != 1:
                return None
            matches.append(part if part in alike else alike[0])
            here = f"{here}/{matches[-1]}"
        return "/".join(matches) if matches and os.path.exists(here) else None

    def _listing(self, folder: str) -> dict[str, list[str]]:
        """The names in a folder by their case-folded form; none in a file."""
        if folder not in self._listings:
            names: dict[str, list[str]] = {}
            for entry in os.listdir(folder) if os.path.isdir(folder) else ():
                names.setdefault(_folded(entry), []).append(entry)
            self._listings[folder] = names
        return self._listings[folder]


def _folded(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()


def refuse_duplicates(where: Path, names: Iterable[str]) -> None:
    """Raise InputError if two photos share a name: they could be in both training and test set."""
    seen: set[str] = set()
    for name in names:
        if name in seen:
            raise InputError(f"{where}: expected every image once, found {name[:_SHOWN]!r} twice")
        seen.add(name)
