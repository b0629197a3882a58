"""The Gaussians that serve as the salt of Argon2id: found in a rounded model, and new in every file.

*Listed* Gaussians have the least public hashes of the cells of red, opacity and the ratios of scales, among
those whose numbers are so far inside of their cells that no format moves them out. Half of them are faint,
so that a new colour is hardly visible; the others are still there when the faintest were removed. Writing
changes none of these numbers.

A salt is a hash of the cells of one listed Gaussian, green and blue included. A writer makes all salts new by
moving green and blue of the listed ones by whole cells, each uniformly by -3 to 3: two files of one model
share each salt with a chance of 1/49.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from keyss.channels.colours.carriers import (
    COLOUR_NOISE,
    COLOUR_STEP,
    OPACITY_NOISE,
    OPACITY_STEP,
    SCALE_STEP,
    Numbers,
)
from keyss.channels.colours.lattice import rank
from keyss.core.arrays import Doubles, Integers
from keyss.keys.derivation import SALT_BYTES

SALTS = 16  # at most; after rounding and random pruning of a quarter, 5 to 12 of them are left
_ENOUGH = 12  # that rounding leaves: of fewer, too few are left after pruning for headers with gaps
_BANDS = (0.08, 0.4, 1.01)  # of opacity, from each of which half of them are
_MAX_MOVED = 3  # cells
_COLOUR_STEPS, _OPACITY_STEPS, _RATIO_STEPS = 5, 16, 8  # that make a cell
# Rounding a number leaves it in its cell, whose borders are borders of rounding too; a ratio moves by a step.
_NOISE = np.array([OPACITY_NOISE / OPACITY_STEP] + [1.0] * 2 + [COLOUR_NOISE / COLOUR_STEP] * 3)
_STEPS = np.array([_OPACITY_STEPS] + [_RATIO_STEPS] * 2 + [_COLOUR_STEPS] * 3)
_CELL = _COLOUR_STEPS * COLOUR_STEP
_UNCHANGED = 4  # of these numbers: opacity, ratios and red
_LABEL = b"keyss/v1/colours-salt"
_PUBLIC = hashlib.sha256(_LABEL).digest()


@dataclass(frozen=True)
class Salts:
    """The listed Gaussians."""

    rows: Integers  # [S] of `Numbers`
    salts: list[bytes]

    @staticmethod
    def of(numbers: Numbers) -> Salts:
        cells, outward = _cells(numbers)
        stable = np.flatnonzero(outward[:, :_UNCHANGED].max(axis=1) < 1)
        band = np.searchsorted(_BANDS, numbers.opacities[stable]) - 1
        listed = []
        for index in range(len(_BANDS) - 1):
            own = stable[band == index]
            _, first = np.unique(rank(_PUBLIC, "salt", cells[own, :_UNCHANGED]), return_index=True)
            listed.append(own[first[: SALTS // (len(_BANDS) - 1)]])  # in ascending order; equal ones once
        rows = np.concatenate(listed)
        return Salts(rows, list(dict.fromkeys(_salt(cells[row]) for row in rows)))


def steady(numbers: Numbers) -> bool:
    """True if rounding leaves so many salts that a header can do without some numbers."""
    kept = set(Salts.of(numbers).salts) & set(Salts.of(numbers.rounded()).salts)
    return len(kept) >= _ENOUGH


def renewed(numbers: Numbers, random: np.random.Generator) -> Numbers:
    """The numbers with another green and blue of listed Gaussians, so that all salts are new."""
    rows, colours = Salts.of(numbers).rows, numbers.colours.copy()
    colours[rows, 1:] += random.integers(-_MAX_MOVED, _MAX_MOVED + 1, (len(rows), 2)) * _CELL
    return replace(numbers, colours=colours)


def _salt(cells: npt.NDArray[np.int16]) -> bytes:
    """SALT_BYTES of the cells [6] of one Gaussian."""
    return hashlib.sha256(_LABEL + cells.astype("<i2").tobytes()).digest()[:SALT_BYTES]


def _cells(numbers: Numbers) -> tuple[npt.NDArray[np.int16], Doubles]:
    """[C, 6] cells of opacity, two ratios, red, green and blue, and how far out the numbers lie.

    Zero is the middle of a cell; above one, a format may move the number out of it.
    """
    steps = np.concatenate(
        [
            numbers.opacities[:, None] / OPACITY_STEP - 0.5,
            np.diff(numbers.log_scales, axis=1) / SCALE_STEP - 0.5,
            numbers.colours / COLOUR_STEP,
        ],
        axis=1,
    )
    places = (steps / _STEPS).clip(-30_000, 30_000)
    cells = np.floor(places)
    outward: Doubles = np.abs(places - cells - 0.5) / (0.5 - _NOISE / _STEPS)
    return cells.astype(np.int16), outward
