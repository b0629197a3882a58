"""Gaussians that carry bits, and the names by which a reader knows them again.

Bits are written into the constant green and blue coefficients of Gaussians (`f_dc_1`, `f_dc_2`): of all
numbers that survive every format, changes of these cost least. A Gaussian is identified by its *name*: the
cells in which two ratios of its scales, its opacity and its red coefficient lie. Writing changes none of
these, and none depends on the model's position, rotation, scale or order.

Borders of cells are borders between rounded values of 8-bit formats (`.spz`: log scales in sixteenths,
colours in steps of 1 / 38.25; opacities in 255ths nearly everywhere), so that rounding moves no number across
one. In a model that was scaled, rounded values lie elsewhere: a reader tries several *alignments*.
`Carriers.error_probability` is the chance that a format has moved a number into another cell.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from keyss.channels.mixing import encrypted_blocks, row_hashes
from keyss.core.arrays import Doubles, Integers, Words, doubles
from keyss.core.gaussians import Gaussians
from keyss.keys.derivation import expand

SCALE_STEPS, COLOUR_STEPS, OPACITY_STEPS = 16, 38.25, 255  # of 8-bit formats, in one
# What formats move these numbers by, in steps, at most: half widths of uniform noise.
SCALE_NOISE, COLOUR_NOISE, OPACITY_NOISE = 0.144, 0.344, 1.02
_RATIO_CELL, _OPACITY_CELL, _RED_CELL = 4, 8, 3  # steps
_MIN_OPACITY = 2.5 / 255  # formats keep the colour of nothing less
_CELLS = 30_000  # on either side of zero: what fits into 16 bits

Names = npt.NDArray[np.int16]


@dataclass(frozen=True, eq=False)
class Carriers:
    """C Gaussians as writer and reader see them."""

    rows: Integers  # [C] of the model
    log_scales: Doubles  # [C, 3]
    opacities: Doubles  # [C]
    colours: Doubles  # [C, 3] constant coefficients
    names: Names  # [C, 4] numbers of cells: ratios of scales, opacity, red
    error_probability: Doubles  # [C] chance that the name has changed since it was written

    @staticmethod
    def of(model: Gaussians, alignment: float = 0.0) -> Carriers:
        """The visible and finite Gaussians.

        `alignment`: what is added to log scales, in steps, to make up for a scaling of the model.
        """
        log_scales, colours = doubles(model.log_scales), doubles(model.sh[:, 0])
        opacities = doubles(model.opacities)
        fine = np.isfinite(log_scales).all(axis=1) & np.isfinite(colours).all(axis=1)
        rows = np.flatnonzero(fine & (opacities > _MIN_OPACITY))
        log_scales, colours, opacities = log_scales[rows], colours[rows], opacities[rows]
        whole, loose = cells_of(log_scales * SCALE_STEPS + 0.5 + alignment, 1, SCALE_NOISE)
        ratios, edge = cells_of(np.diff(whole, axis=1) + 0.5, _RATIO_CELL, 1.0)  # a quarter beside a border
        opacity, faint = cells_of(opacities[:, None] * OPACITY_STEPS - 0.5, _OPACITY_CELL, OPACITY_NOISE)
        red, off = cells_of(colours[:, :1] * COLOUR_STEPS, _RED_CELL, COLOUR_NOISE)
        doubts = np.hstack([2 * edge * (loose[:, 1:] + loose[:, :-1]), faint, off])
        names = np.hstack([ratios, opacity, red]).astype(np.int16)
        return Carriers(rows, log_scales, opacities, colours, names, 1 - (1 - doubts).prod(axis=1))

    def __len__(self) -> int:
        return len(self.rows)

    @cached_property
    def impact(self) -> Doubles:
        """[C] how much a change of colour shows: log of area times squared opacity of the cell."""
        opacities = (self.names[:, 2] + 0.5) * _OPACITY_CELL / OPACITY_STEPS
        impact: Doubles = np.sort(self.log_scales)[:, 1:].sum(axis=1) + 2 * np.log(opacities.clip(1e-3))
        return impact

    @cached_property
    def name_counts(self) -> Integers:
        """[C] how many carriers have the same name, itself included."""
        _, inverse, counts = np.unique(row_hashes(self.names), return_inverse=True, return_counts=True)
        return counts[inverse].astype(np.int64)

    @cached_property
    def representatives(self) -> Integers:
        """[D] the carrier of each name that is least in doubt: only this one is written."""
        order = np.argsort(self.error_probability, kind="stable")
        _, first = np.unique(row_hashes(self.names)[order], return_index=True)
        return np.sort(order[first])


def random_pairs(secret: bytes, label: str, names: Names) -> Words:
    """[C, 2] 64 bits each for names [C, 4], pseudo-random without the secret: AES-256 of the names."""
    blocks = np.zeros((len(names), 8), "<i2")  # of AES
    blocks[:, : names.shape[1]] = names
    key = expand(secret, f"colours/{label}", 32)
    return encrypted_blocks(key, blocks.view(np.uint8)).view("<u8").astype(np.uint64)


def fractions(secret: bytes, label: str, names: Names) -> Doubles:
    """[C, 2] numbers in [0, 1) for names [C, 4]; equal for equal names."""
    return (random_pairs(secret, label, names) >> np.uint64(11)) / 2.0**53


def cells_of(values: Doubles, steps: int, noise: float) -> tuple[Doubles, Doubles]:
    """Cells of `steps` steps each, of values [C, k] in steps, and the chances of having left them."""
    cells = np.floor(values / steps)
    inside = values - cells * steps
    nearest = np.minimum(inside, steps - inside)
    return cells.clip(-_CELLS, _CELLS), ((noise - nearest) / (2 * noise)).clip(0, 0.5)
