"""Orders of Gaussians: one in which bits are counted, and the one of the file.

Formats whose order does not depend on what is written keep it. A .sog is sorted by `in_morton_order`; its
bits are counted in an order of what is not written.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from keyss.channels.codes.fields import Field, Flags, format_of, sog_distances
from keyss.channels.mixing import row_hashes
from keyss.files.formats.common import Codes, Floats, morton_order
from keyss.files.formats.sog import SogCodes, positions_of

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
        """Of a .sog's Gaussians that are alike in all that is not written, none carries."""
        if not isinstance(codes, SogCodes):
            fields = format_of(codes).fields(codes)
            return Counted(codes, np.arange(len(fields[0].levels)), fields)
        rows, alike = _sog_order(codes)
        codes = taken(codes, rows)
        fields = format_of(codes).fields(codes)
        return Counted(codes, rows, [replace(each, bits=np.where(alike, 0, each.bits)) for each in fields])


def taken(codes: SogCodes, rows: Rows) -> SogCodes:
    """The codes of a .sog in another order."""
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


def _sog_order(codes: SogCodes) -> tuple[Rows, Flags]:
    """Gaussians [N] by hashes of what is not written, and which of them, in that order, share one.

    Where two are equal by chance, a little room is lost.
    """
    parts = (codes.scales, codes.colors, codes.alphas, codes.labels, codes.largest)
    levels = sog_distances(codes, codes.positions)
    names = row_hashes(np.concatenate([each.reshape(len(levels), -1) for each in (*parts, levels)], axis=1))
    rows = np.argsort(names, kind="stable")
    same = np.diff(names[rows]) == 0
    alike: Flags = np.append(same, False) | np.append(False, same)
    return rows, alike
