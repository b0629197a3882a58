"""The Gaussians that serve as the salt of Argon2id: found in a rounded model, and new in every file.

*Listed* are the Gaussians with the least public hashes of the cells in which their red coefficient, their
opacity and the ratios of their scales lie, of those where these are in the inner part of their cells, from
where no format moves them out: half of them faint ones, on which a new colour is hardly seen, and half
others, which are still there when the faintest were removed. Writing changes none of these numbers. A salt
is a hash of the cells of one listed Gaussian, green and blue included. To have new salts, a writer moves
green and blue of the listed ones by whole cells, at random and by at most 0.4. Where
they lie inside of their cells stays as it is, so that nothing tells that this has happened.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from keyss.channels.robust.carriers import (
    COLOUR_NOISE,
    COLOUR_STEP,
    OPACITY_NOISE,
    OPACITY_STEP,
    SCALE_STEP,
    Doubles,
    Numbers,
)
from keyss.channels.robust.lattice import rank
from keyss.keys.derivation import SALT_BYTES

SALTS = 16  # at most; after rounding and random pruning of a quarter, 5 to 12 of them are left
_BANDS = (0.08, 0.4, 1.01)  # of opacity, from each of which half of them are
_MOST_MOVED = (3, 3)  # cells, by band: with fewer, two files of one model would often share a salt
_COLOUR_STEPS, _OPACITY_STEPS, _RATIO_STEPS = 5, 16, 8  # that make a cell
# Rounding a number leaves it in its cell, whose borders are borders of rounding too; a ratio moves by a step.
_NOISE = np.array([OPACITY_NOISE / OPACITY_STEP] + [1.0] * 2 + [COLOUR_NOISE / COLOUR_STEP] * 3)
_STEPS = np.array([_OPACITY_STEPS] + [_RATIO_STEPS] * 2 + [_COLOUR_STEPS] * 3)
_UNCHANGED = 4  # of these numbers: opacity, ratios and red
_LABEL = b"keyss/v1/robust-salt"
_PUBLIC = hashlib.sha256(_LABEL).digest()


@dataclass(frozen=True)
class Salts:
    """The listed Gaussians."""

    rows: npt.NDArray[np.int64]  # [S] of `Numbers`
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


def renewed(numbers: Numbers, random: np.random.Generator) -> Numbers:
    """The numbers with another green and blue of listed Gaussians, so that all salts are new."""
    rows = Salts.of(numbers).rows
    colours = numbers.colours.copy()
    most = np.array(_MOST_MOVED)[np.searchsorted(_BANDS, numbers.opacities[rows]) - 1]
    moves = random.integers(-most[:, None], most[:, None] + 1, (len(rows), 2))
    colours[rows, 1:] += moves * _COLOUR_STEPS * COLOUR_STEP
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
