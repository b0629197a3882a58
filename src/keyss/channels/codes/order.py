"""Orders of Gaussians: one in which bits are counted, and the one of the file.

Formats whose order does not depend on written codes keep it. A .sog is sorted by `in_morton_order`; its bits
are counted in an order of codes that are not written.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from keyss.channels.codes.fields import Field, carrying, sog_distances
from keyss.channels.mixing import row_hashes
from keyss.core.arrays import Doubles, Flags, Floats, Integers
from keyss.files.formats.common import Codes, morton_order
from keyss.files.formats.sog import SogCodes

_SOG_ARRAYS = ("positions", "largest", "rotations", "scales", "colors", "alphas", "labels")


def in_counted_order(codes: Codes) -> tuple[Any, list[Field]]:
    """The codes in the order in which bits are counted, and their fields.

    Gaussians of a .sog that are alike in all codes that are not written carry nothing.
    """
    if not isinstance(codes, SogCodes):
        return codes, carrying(codes).fields(codes)
    rows, alike = _sog_order(codes)
    codes = _taken(codes, rows)
    fields = carrying(codes).fields(codes)
    return codes, [replace(each, bits=np.where(alike, 0, each.bits)) for each in fields]


def in_file_order(codes: Codes, within: Doubles) -> Any:
    """The codes as a writer of the format sorts them.

    It sorts before it rounds, so that a few neighbours seem to be out of order. `within` [N, 3], random in
    [-0.5, 0.5]: how far above their levels the numbers were. Extremes lie on their levels.
    """
    if not isinstance(codes, SogCodes):
        return codes
    levels = codes.positions
    extreme = (levels == levels.min(axis=0)) | (levels == levels.max(axis=0))
    means: Floats = codes.positions_at(levels + np.where(extreme, 0.0, within)).astype(np.float32)
    return _taken(codes, morton_order(means))


def _taken(codes: SogCodes, rows: Integers) -> SogCodes:
    return replace(codes, **{name: getattr(codes, name)[rows] for name in _SOG_ARRAYS})


def _sog_order(codes: SogCodes) -> tuple[Integers, Flags]:
    """The rows [N] by hashes of codes that are not written, and which of them, in that order, share one.

    Where two hashes are equal by chance, a little room is lost.
    """
    parts = (codes.scales, codes.colors, codes.alphas, codes.labels, codes.largest)
    levels = sog_distances(codes, codes.positions)
    names = row_hashes(np.concatenate([each.reshape(len(levels), -1) for each in (*parts, levels)], axis=1))
    rows = np.argsort(names, kind="stable")
    same = np.diff(names[rows]) == 0
    alike: Flags = np.append(same, False) | np.append(False, same)
    return rows, alike
