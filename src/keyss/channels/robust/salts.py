"""The Gaussians that serve as the salt of Argon2id: found in a rounded model, and new in every file.

*Listed* are the Gaussians with the least public hashes of the cells in which their red coefficient, their
opacity and the ratios of their scales lie, of those where these are in the inner part of their cells, from
where no format moves them out. Writing changes none of these numbers. A salt is a hash of the cells of one
listed Gaussian, green and blue included; the best salts are those with all numbers far inside. To have new
salts, a writer moves green and blue of the listed ones by whole cells, at random and by at most 0.4. Where
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

SALTS = 10  # that are written for and tried: random pruning of a quarter removes all with p = 1e-6
_LISTED = 12  # Gaussians; rounding brings in a few others
_OPACITIES = 0.08, 0.4  # of listed ones: a new colour is hardly seen, and hardly any pruning removes them
_COLOUR_STEPS, _OPACITY_STEPS, _RATIO_STEPS = 5, 16, 8  # that make a cell
# Rounding a number leaves it in its cell, whose borders are borders of rounding too; a ratio moves by a step.
_NOISE = np.array([OPACITY_NOISE / OPACITY_STEP] + [1.0] * 2 + [COLOUR_NOISE / COLOUR_STEP] * 3)
_STEPS = np.array([_OPACITY_STEPS] + [_RATIO_STEPS] * 2 + [_COLOUR_STEPS] * 3)
_UNCHANGED = 4  # of these numbers: opacity, ratios and red
_MOST_MOVED = 3  # cells
_LABEL = b"keyss/v1/robust-salt"
_PUBLIC = hashlib.sha256(_LABEL).digest()


@dataclass(frozen=True)
class Salts:
    """The listed Gaussians, the best first."""

    rows: npt.NDArray[np.int64]  # [S] of `Numbers`
    salts: list[bytes]

    @staticmethod
    def of(numbers: Numbers) -> Salts:
        cells, outward = _cells(numbers)
        faint = (numbers.opacities > _OPACITIES[0]) & (numbers.opacities < _OPACITIES[1])
        stable = np.flatnonzero((outward[:, :_UNCHANGED].max(axis=1) < 1) & faint)
        hashes = rank(_PUBLIC, "salt", cells[stable, :_UNCHANGED])
        _, first = np.unique(hashes, return_index=True)  # in ascending order; equal ones once
        listed = stable[first[:_LISTED]]
        listed = listed[np.argsort(outward[listed].max(axis=1), kind="stable")]
        return Salts(listed, [_salt(cells[row]) for row in listed])


def renewed(numbers: Numbers, random: np.random.Generator) -> Numbers:
    """The numbers with another green and blue of listed Gaussians, so that all salts are new."""
    rows = Salts.of(numbers).rows
    colours = numbers.colours.copy()
    moves = random.integers(-_MOST_MOVED, _MOST_MOVED, (len(rows), 2), endpoint=True)
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
