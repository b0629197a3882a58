"""Which numbers of a model carry bits, and by which others a reader identifies them.

Bits are written into the constant green and blue coefficients of Gaussians (`f_dc_1`, `f_dc_2`): of all
numbers that survive every format, changes of these cost least. A Gaussian is identified by its *name*: the
cells in which its three log scales, its opacity and its red coefficient lie. Writing changes none of these,
and none depends on the model's position, rotation or order.

Borders of cells are the borders between two roundings of 8-bit formats (`.spz`: log scales in sixteenths,
colours in steps of 1 / 38.25; opacities in 255ths nearly everywhere), so that rounding moves no number across
one. `Carriers.doubt` is the chance that another format or another change has done so.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from torch import Tensor

from keyss.channels.mixing import row_hashes
from keyss.core.arrays import Doubles, Flags, Integers
from keyss.core.gaussians import Gaussians

SCALE_STEP, COLOUR_STEP, OPACITY_STEP = 1 / 16, 1 / 38.25, 1 / 255  # of 8-bit formats
CELL = 0.25  # of a log scale
_SCALE_STEPS, _COLOUR_STEPS, _OPACITY_STEPS = 4, 5, 16  # that make a cell
_MIN_OPACITY = 2.5 / 255  # formats keep the colour of nothing less
# What formats move these numbers by, at most (`.spz` aside, see above): half widths of uniform noise.
_SCALE_NOISE, COLOUR_NOISE, OPACITY_NOISE = 0.018, 0.009, 0.004
_SCALE_ROUNDED = SCALE_STEP / 2  # where borders lie elsewhere, by `.spz` as well
_CELLS = 30_000  # on either side of zero: what fits into 16 bits

Names = npt.NDArray[np.int16]


@dataclass(frozen=True)
class Numbers:
    """The numbers of the C Gaussians that can carry something."""

    rows: Integers  # [C] of the model
    log_scales: Doubles  # [C, 3]
    opacities: Doubles  # [C]
    colours: Doubles  # [C, 3] constant coefficients

    @staticmethod
    def of(model: Gaussians) -> Numbers:
        """The visible and finite Gaussians."""
        log_scales, colours = _doubles(model.log_scales), _doubles(model.sh[:, 0])
        opacities = _doubles(model.opacities)
        fine = np.isfinite(log_scales).all(axis=1) & np.isfinite(colours).all(axis=1)
        rows = np.flatnonzero(fine & (opacities > _MIN_OPACITY))
        return Numbers(rows, log_scales[rows], opacities[rows], colours[rows])

    def rounded(self) -> Numbers:
        """As `.spz` leaves them."""
        return Numbers(
            self.rows,
            np.round(self.log_scales / SCALE_STEP) * SCALE_STEP,
            np.round(self.opacities / OPACITY_STEP) * OPACITY_STEP,
            (np.round(self.colours / COLOUR_STEP + 127.5) - 127.5) * COLOUR_STEP,
        )

    @property
    def size(self) -> float:
        """The median log scale, which follows the scale of the model."""
        return float(np.median(self.log_scales.mean(axis=1))) if len(self.rows) else 0.0

    def carriers(self, offset: float) -> Carriers:
        """The carriers and their names. `offset`: the log scale that counts as zero.

        An offset that is a multiple of `CELL` keeps the borders where formats have theirs.
        """
        noise = _SCALE_NOISE if offset % CELL == 0 else _SCALE_ROUNDED
        parts = (
            _cells((self.log_scales - offset) / SCALE_STEP - 0.5, _SCALE_STEPS, noise / SCALE_STEP),
            _cells(
                self.opacities[:, None] / OPACITY_STEP - 0.5, _OPACITY_STEPS, OPACITY_NOISE / OPACITY_STEP
            ),
            _cells(self.colours[:, :1] / COLOUR_STEP, _COLOUR_STEPS, COLOUR_NOISE / COLOUR_STEP),
        )
        names = np.concatenate([cells for cells, _ in parts], axis=1)
        stays = np.prod([(1 - doubt).prod(axis=1) for _, doubt in parts], axis=0)
        return Carriers(self.rows, names, 1 - stays, self.colours[:, 1:])


@dataclass(frozen=True)
class Carriers:
    """C Gaussians as writer and reader see them."""

    rows: Integers  # [C] of the model
    names: Names  # [C, 5] numbers of cells: log scales, opacity, red
    doubt: Doubles  # [C] chance that the name is not what it was when it was written
    values: Doubles  # [C, 2] green and blue

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, which: Integers | Flags) -> Carriers:
        return Carriers(self.rows[which], self.names[which], self.doubt[which], self.values[which])

    def shifted(self, cells: int) -> Carriers:
        """As with an offset that is larger by so many cells."""
        moved = self.names - np.array([cells] * 3 + [0] * 2, np.int16)
        return Carriers(self.rows, moved, self.doubt, self.values)

    @property
    def impact(self) -> Doubles:
        """[C] how much a change of colour shows, from the name: log of area times squared opacity."""
        log_scales = np.sort((self.names[:, :3] + 0.5) * CELL, axis=1)
        opacities = (self.names[:, 3] + 0.5) * _OPACITY_STEPS * OPACITY_STEP
        impact: Doubles = log_scales[:, 1] + log_scales[:, 2] + 2 * np.log(opacities.clip(1e-3))
        return impact

    def namesakes(self) -> Integers:
        """[C] how many carriers have the same name, itself included."""
        _, inverse, counts = np.unique(row_hashes(self.names), return_inverse=True, return_counts=True)
        return counts[inverse].astype(np.int64)

    def one_of_each(self) -> Integers:
        """[D] the carrier of each name that is least in doubt: only this one is written."""
        order = np.argsort(self.doubt, kind="stable")
        _, first = np.unique(row_hashes(self.names)[order], return_index=True)
        return np.sort(order[first])


def _cells(values: Doubles, steps: int, noise: float) -> tuple[Names, Doubles]:
    """Cells of `steps` steps each, of values [C, k] in steps, and the chances of having left them."""
    cells = np.floor(values / steps)
    inside = values - cells * steps
    nearest = np.minimum(inside, steps - inside)
    doubt = ((noise - nearest) / (2 * noise)).clip(0, 0.5)
    return cells.clip(-_CELLS, _CELLS).astype(np.int16), doubt


def _doubles(values: Tensor) -> Doubles:
    return values.detach().cpu().numpy().astype(np.float64)
