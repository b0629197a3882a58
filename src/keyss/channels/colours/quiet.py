"""Which Gaussians a writer leaves alone, and which values look like those of the model.

Readers need not know: a number that was left alone reads as lost.
"""

from __future__ import annotations

import numpy as np

from keyss.channels.colours.lattice import SPACING
from keyss.core.arrays import Doubles, Flags, Floats, Integers
from keyss.core.gaussians import Gaussians

_ROUNDED = 0.25  # share of repeated colours from which on a model is a rounded one
_LOW = np.uint32(1023)  # bits of a float that stay
_SHORT = np.uint32((1 << 20) - 1)  # a number whose last bits are all zero was typed, not trained


class Quiet:
    """The constant colours of a model with N Gaussians, as training or rounding left them."""

    def __init__(self, model: Gaussians) -> None:
        self._colours: Floats = model.sh[:, 0].detach().cpu().float().numpy()
        every = [np.unique(column, return_inverse=True, return_counts=True) for column in self._colours.T]
        repeated = np.stack([counts[inverse.ravel()] > 1 for _, inverse, counts in every], axis=1)
        self._values = [values for values, _, _ in every]
        self._rounded = bool(len(repeated)) and float(repeated.mean()) > _ROUNDED
        self._repeated = repeated.any(axis=1)

    def left_alone(self) -> Flags:
        """[N] Gaussians with a colour that is repeated, typed, or equal in two channels.

        None of a rounded model, where all are repeated. Colours that are nearly equal are not left alone:
        there would be too many of them beside those that the others were moved away from.
        """
        if self._rounded or not len(self._colours):
            return np.zeros(len(self._colours), bool)
        typed = ((self._colours.view(np.uint32) & _SHORT) == 0).any(axis=1)
        alone: Flags = self._repeated | typed
        alone |= (self._colours == np.roll(self._colours, 1, axis=1)).any(axis=1)
        return alone

    def fitted(self, rows: Integers, column: int, new: Doubles) -> Floats:
        """[R] `new` values of a column as this model would have them.

        In a rounded model: the nearest value that it has, if a reader reads the same from it. In others: with
        the last bits of the old values, which are not quite random after training.
        """
        old, values = self._colours[rows, column], self._values[column]
        if self._rounded:
            above = np.searchsorted(values, new).clip(1, len(values) - 1) if len(values) > 1 else 0
            below = values[np.maximum(above - 1, 0)]
            nearest = np.where(new - below < values[above] - new, below, values[above])
            return np.where(np.abs(nearest - new) <= SPACING / 2, nearest, new).astype(np.float32)
        bits = new.astype(np.float32).view(np.uint32) & ~_LOW | old.view(np.uint32) & _LOW
        same: Floats = bits.view(np.float32)
        return same
