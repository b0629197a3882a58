"""Orders of Gaussians: one in which bits are counted, and the one of the file; and which do not carry.

Formats whose order does not depend on what is written keep it. A .sog is sorted by `in_morton_order`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from keyss.channels.codes.fields import Field, Flags, fields_of, position_cells
from keyss.files.formats.common import Codes, Floats, morton_order
from keyss.files.formats.compressed_ply import CHUNK, CompressedPlyCodes
from keyss.files.formats.sog import SogCodes, positions_of
from keyss.files.formats.spz import SpzCodes

Rows = npt.NDArray[np.intp]

_SOG_ARRAYS = ("positions", "largest", "rotations", "scales", "colors", "alphas", "labels")


@dataclass(frozen=True)
class Counted:
    """Codes in the order in which bits are counted, and what carries."""

    codes: Any  # Codes
    rows: Rows  # [N] where they come from
    fields: list[Field]

    @staticmethod
    def of(codes: Codes) -> Counted:
        """Clones carry nothing: their codes are equal, and would differ afterwards."""
        rows = (
            _sog_order(codes) if isinstance(codes, SogCodes) else np.arange(len(fields_of(codes)[0].levels))
        )
        codes = taken(codes, rows)
        alone = ~_clones(codes)
        return Counted(codes, rows, [replace(each, usable=each.usable & alone) for each in fields_of(codes)])


def taken(codes: Codes, rows: Rows) -> Any:
    """The codes of a .sog in another order, and those of other formats as they are."""
    if not isinstance(codes, SogCodes):
        return codes
    return replace(codes, **{name: getattr(codes, name)[rows] for name in _SOG_ARRAYS})


def in_file_order(codes: Codes, within: npt.NDArray[np.float64]) -> Any:
    """The codes as a writer of the format sorts them.

    It sorts before it rounds, so that a few neighbours seem to be out of order. `within` [N, 3]: where
    between half a level below and above the numbers lay, at random; extremes lie on their levels, and the
    curve goes between them.
    """
    if not isinstance(codes, SogCodes):
        return codes
    levels = codes.positions
    extreme = (levels == levels.min(axis=0)) | (levels == levels.max(axis=0))
    means: Floats = positions_of(codes, levels + np.where(extreme, 0.0, within)).astype(np.float32)
    return taken(codes, morton_order(means))


def _sog_order(codes: SogCodes) -> Rows:
    """By the cells that positions stay in; of several in one cell, which are clones, none carries."""
    x, y, z = (position_cells(codes)).T
    return np.lexsort((z, y, x))


def _clones(codes: Codes) -> Flags:
    """[N] which Gaussians are like another one in everything that writing leaves as it is."""
    if isinstance(codes, (SogCodes, SpzCodes)):
        names = _hashed(position_cells(codes))
    else:
        assert isinstance(codes, CompressedPlyCodes)
        chunks = np.arange(len(codes)) // CHUNK
        names = _hashed(codes.positions, codes.sh, codes.largest, chunks)
    _, which, count = np.unique(names, return_inverse=True, return_counts=True)
    found: Flags = count[which] > 1
    return found


def _hashed(*arrays: npt.NDArray[Any]) -> npt.NDArray[np.uint64]:
    """[N] a hash of each row of arrays [N, ...]; where two are equal by chance, a little room is lost."""
    found = np.zeros(len(arrays[0]), np.uint64)
    for each in arrays:
        for column in each.reshape(len(each), -1).T:
            found = (found ^ column.astype(np.uint64)) * np.uint64(0x9E3779B97F4A7C15)
            found ^= found >> np.uint64(29)
    return found
