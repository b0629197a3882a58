"""Which numbers of a model carry bits, and by which others a reader identifies them.

Bits are written into the constant green and blue coefficients of Gaussians (`f_dc_1`, `f_dc_2`): of all
numbers that survive every format, changes of these cost least. A Gaussian is identified by its *name*: the
cells in which its three log scales, its opacity and its red coefficient lie. Writing changes none of these,
and none depends on the model's position, rotation or order.

Borders of cells are borders between rounded values of 8-bit formats (`.spz`: log scales in sixteenths,
colours in steps of 1 / 38.25; opacities in 255ths nearly everywhere), so that rounding moves no number across
one. `Carriers.doubt` is the chance that another format or another change has done so.

Some Gaussians serve as the salt of Argon2id: found in a rounded model, and new in every file. *Listed*
Gaussians have the least public hashes of the cells of red, opacity and the ratios of scales, among those
whose numbers are so far inside of their cells that no format moves them out. Half of them are faint, so that
a new colour is hardly visible; the others are still there when the faintest were removed. Writing changes
none of these numbers.

A salt is a hash of the cells of one listed Gaussian, green and blue included. A writer makes all salts new by
moving green and blue of the listed ones by whole cells, each uniformly by -3 to 3: two files of one model
share each salt with a chance of 1/49.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from keyss.channels.mixing import encrypted_blocks, row_hashes
from keyss.core.arrays import Doubles, Flags, Integers, Words, doubles
from keyss.core.gaussians import Gaussians
from keyss.keys.derivation import SALT_BYTES, expand

SCALE_STEP, COLOUR_STEP, OPACITY_STEP = 1 / 16, 1 / 38.25, 1 / 255  # of 8-bit formats
CELL = 0.25  # of a log scale
_SCALE_STEPS, _RATIO_STEPS, _COLOUR_STEPS, _OPACITY_STEPS = 4, 8, 5, 16  # steps of a cell
_MIN_OPACITY = 2.5 / 255  # formats keep the colour of nothing less
# What formats move these numbers by, at most (`.spz` aside, see above): half widths of uniform noise.
_SCALE_NOISE, COLOUR_NOISE, OPACITY_NOISE = 0.018, 0.009, 0.004
_SCALE_ROUNDED = SCALE_STEP / 2  # where borders lie elsewhere, by `.spz` as well
_NAME_BYTES = 16  # one block of AES
_CELLS = 30_000  # on either side of zero: what fits into 16 bits

Names = npt.NDArray[np.int16]

SALTS = 16  # at most; after rounding and random pruning of a quarter, 5 to 12 of them are left
_ENOUGH = 12  # that rounding leaves: of fewer, too few are left after pruning for headers with gaps
_BANDS = (0.08, 0.4, 1.01)  # limits of two bands of opacity, with half of the salts each
_MAX_MOVED = 3  # cells
# Rounding a number leaves it in its cell, whose borders are borders of rounding too; a ratio moves by a step.
_NOISE = np.array([OPACITY_NOISE / OPACITY_STEP] + [1.0] * 2 + [COLOUR_NOISE / COLOUR_STEP] * 3)
_STEPS = np.array([_OPACITY_STEPS] + [_RATIO_STEPS] * 2 + [_COLOUR_STEPS] * 3)
_CELL = _COLOUR_STEPS * COLOUR_STEP
_UNCHANGED = 4  # of these numbers: opacity, ratios and red
_LABEL = b"keyss/v1/colours-salt"
_PUBLIC = hashlib.sha256(_LABEL).digest()


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
        log_scales, colours = doubles(model.log_scales), doubles(model.sh[:, 0])
        opacities = doubles(model.opacities)
        fine = np.isfinite(log_scales).all(axis=1) & np.isfinite(colours).all(axis=1)
        rows = np.flatnonzero(fine & (opacities > _MIN_OPACITY))
        return Numbers(rows, log_scales[rows], opacities[rows], colours[rows])

    def rounded(self) -> Numbers:
        """The numbers as `.spz` rounds them."""
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
    doubt: Doubles  # [C] chance that the name has changed since it was written
    values: Doubles  # [C, 2] green and blue

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, which: Integers | Flags) -> Carriers:
        return Carriers(self.rows[which], self.names[which], self.doubt[which], self.values[which])

    def shifted(self, cells: int) -> Carriers:
        """The carriers under an offset that is larger by so many cells."""
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


def rank(secret: bytes, label: str, names: Names) -> Words:
    """[C] a number for each name [C, k], k at most 8; equal for equal names."""
    return random_pairs(secret, label, names)[:, 0]


def random_pairs(secret: bytes, label: str, names: Names) -> Words:
    """[C, 2] 64 bits each, pseudo-random without the secret: AES-256 of the names."""
    blocks = np.zeros((len(names), _NAME_BYTES // 2), "<i2")
    blocks[:, : names.shape[1]] = names
    key = expand(secret, f"colours/{label}", 32)
    return encrypted_blocks(key, blocks.view(np.uint8)).view("<u8").astype(np.uint64)


def _cells(values: Doubles, steps: int, noise: float) -> tuple[Names, Doubles]:
    """Cells of `steps` steps each, of values [C, k] in steps, and the chances of having left them."""
    cells = np.floor(values / steps)
    inside = values - cells * steps
    nearest = np.minimum(inside, steps - inside)
    doubt = ((noise - nearest) / (2 * noise)).clip(0, 0.5)
    return cells.clip(-_CELLS, _CELLS).astype(np.int16), doubt


@dataclass(frozen=True)
class Salts:
    """The listed Gaussians."""

    rows: Integers  # [S] of `Numbers`
    salts: list[bytes]

    @staticmethod
    def of(numbers: Numbers) -> Salts:
        cells, outward = _salt_cells(numbers)
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


def _salt(cells: Names) -> bytes:
    """SALT_BYTES of the cells [6] of one Gaussian."""
    return hashlib.sha256(_LABEL + cells.astype("<i2").tobytes()).digest()[:SALT_BYTES]


def _salt_cells(numbers: Numbers) -> tuple[Names, Doubles]:
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
    places = (steps / _STEPS).clip(-_CELLS, _CELLS)
    cells = np.floor(places)
    outward: Doubles = np.abs(places - cells - 0.5) / (0.5 - _NOISE / _STEPS)
    return cells.astype(np.int16), outward
