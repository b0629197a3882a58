"""Gaussians that serve as the salt of Argon2id: found in a rounded model, and new in every file.

*Listed* Gaussians have the least public hashes of the cells of opacity, ratios of scales and red, among those
whose numbers are so far inside of their cells that no format moves them out. Half of them are faint, so that
a new colour is hardly visible; the others are still there when the faintest were removed.

A salt is a hash of the cells of one listed Gaussian, green and blue included. A writer makes all salts new by
moving green and blue of the listed ones by whole cells, each uniformly by -3 to 3: two files of one model
share each salt with a chance of 1/49.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from keyss.channels.colours.carriers import (
    COLOUR_NOISE,
    COLOUR_STEPS,
    OPACITY_NOISE,
    OPACITY_STEPS,
    SCALE_STEPS,
    Carriers,
    cells_of,
    fractions,
)
from keyss.core.arrays import Integers
from keyss.keys.derivation import SALT_BYTES

SALTS = 16  # at most; after rounding and random pruning of a quarter, 5 to 12 of them are left
_BANDS = (0.08, 0.4, 1.01)  # limits of two bands of opacity, with half of the salts each
_MAX_MOVED = 3  # cells
_OPACITY_CELL, _RATIO_CELL, _COLOUR_CELL = 16, 8, 5  # steps
_LABEL = b"keyss/v1/colours-salt"
_PUBLIC = hashlib.sha256(_LABEL).digest()


@dataclass(frozen=True)
class Salts:
    """The listed Gaussians."""

    rows: Integers  # [S] of the carriers
    salts: list[bytes]

    @staticmethod
    def of(carriers: Carriers) -> Salts:
        ratios = np.diff(carriers.log_scales, axis=1) * SCALE_STEPS - 0.5
        opacities = carriers.opacities[:, None] * OPACITY_STEPS - 0.5
        parts = (
            cells_of(opacities, _OPACITY_CELL, OPACITY_NOISE),
            cells_of(ratios, _RATIO_CELL, 1.0),
            cells_of(carriers.colours * COLOUR_STEPS, _COLOUR_CELL, COLOUR_NOISE),
        )
        cells = np.hstack([own for own, _ in parts]).astype("<i2")
        stable = (np.hstack([doubt for _, doubt in parts])[:, :4] == 0).all(axis=1)
        hashes = fractions(_PUBLIC, "salt", cells[:, :4])[:, 0]
        listed = []
        for low, high in pairwise(_BANDS):
            own = np.flatnonzero(stable & (carriers.opacities > low) & (carriers.opacities <= high))
            _, first = np.unique(hashes[own], return_index=True)
            listed.append(own[first[: SALTS // (len(_BANDS) - 1)]])
        rows = np.concatenate(listed)
        salts = [hashlib.sha256(_LABEL + cells[row].tobytes()).digest()[:SALT_BYTES] for row in rows]
        return Salts(rows, list(dict.fromkeys(salts)))


def renew_salts(carriers: Carriers, random: np.random.Generator) -> Carriers:
    """The carriers with another green and blue of listed ones, so that all salts are new."""
    rows, colours = Salts.of(carriers).rows, carriers.colours.copy()
    cells = random.integers(-_MAX_MOVED, _MAX_MOVED + 1, (len(rows), 2))
    colours[rows, 1:] += cells * _COLOUR_CELL / COLOUR_STEPS
    return replace(carriers, colours=colours)
