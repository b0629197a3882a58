"""Ordinary point clouds in PLY files: positions and colours, nothing of Gaussians."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from keyss.core.errors import InputError
from keyss.files.layout import PointCloud
from keyss.files.ply_table import read_vertices

_POSITION = ["x", "y", "z"]
_COLOR = ["red", "green", "blue"]
_GREY = 128  # for points without colours


def read_point_cloud(path: Path) -> PointCloud:
    """The `x y z` and, where there are any, `red green blue` (uchar) of a PLY's vertices.

    Raises InputError when the file is no such PLY, is truncated or holds coordinates that are not finite.
    """

    def choose(found: dict[str, str]) -> list[str]:
        missing = [name for name in _POSITION if name not in found]
        if missing:
            raise InputError(f"{path}: expected vertices with x, y and z, found none of {', '.join(missing)}")
        colors = {name: found[name] for name in _COLOR if name in found}
        if not colors:
            return _POSITION
        if list(colors.values()) != ["u1", "u1", "u1"]:
            raise InputError(f"{path}: expected red, green and blue of type uchar, found {colors}")
        return _POSITION + _COLOR

    names, rows = read_vertices(path, choose)
    rgb = np.full((len(rows), 3), _GREY, dtype=np.uint8)
    if len(names) > 3:
        values = rows[:, 3:]
        if not ((values >= 0) & (values <= 255)).all():  # possible in ascii
            raise InputError(f"{path}: expected colours of 0 to 255, found others")
        rgb = values.astype(np.uint8)
    return PointCloud.checked(path, rows[:, :3].astype(np.float64), rgb)
