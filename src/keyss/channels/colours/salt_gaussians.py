"""Salts of Argon2id, derived from Gaussians: they survive rounding and are new in every file.

*Salt Gaussians* have the smallest public hashes of their cells (opacity, ratios of scales, red), among the
Gaussians whose numbers no format can move into another cell. Half of them are faint, so that a new colour is
hardly visible; the other half survives the removal of faint Gaussians.

A salt is a hash of the cells of one salt Gaussian, green and blue included. A writer moves green and blue by
a uniformly random number of cells, -3 to 3, which makes all salts new: two files of one model share each salt
with a probability of 1/49.
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

SALTS = 16  # maximum; 5 to 12 survive rounding and random pruning of a quarter
_BANDS = (0.08, 0.4, 1.01)  # limits of two opacity bands with half of the salts each
_MAX_MOVED = 3  # cells
_OPACITY_CELL, _RATIO_CELL, _COLOUR_CELL = 16, 8, 5  # steps
_LABEL = b"keyss/v1/colours-salt"
_PUBLIC = hashlib.sha256(_LABEL).digest()


@dataclass(frozen=True)
class Salts:
    """The salt Gaussians of a model, and their salts."""

    rows: Integers  # [S] indices of carriers
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
        cells = np.hstack([part for part, _ in parts]).astype("<i2")
        stable = (np.hstack([error for _, error in parts])[:, :4] == 0).all(axis=1)
        hashes = fractions(_PUBLIC, "salt", cells[:, :4])[:, 0]
        chosen = []
        for low, high in pairwise(_BANDS):
            band = np.flatnonzero(stable & (carriers.opacities > low) & (carriers.opacities <= high))
            _, first = np.unique(hashes[band], return_index=True)
            chosen.append(band[first[: SALTS // (len(_BANDS) - 1)]])
        rows = np.concatenate(chosen)
        salts = [hashlib.sha256(_LABEL + cells[row].tobytes()).digest()[:SALT_BYTES] for row in rows]
        return Salts(rows, list(dict.fromkeys(salts)))


def renew_salts(carriers: Carriers, random: np.random.Generator) -> Carriers:
    """The carriers with new greens and blues of salt Gaussians, hence new salts."""
    rows, colours = Salts.of(carriers).rows, carriers.colours.copy()
    cells = random.integers(-_MAX_MOVED, _MAX_MOVED + 1, (len(rows), 2))
    colours[rows, 1:] += cells * _COLOUR_CELL / COLOUR_STEPS
    return replace(carriers, colours=colours)
