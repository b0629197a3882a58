"""Siblings that moved apart by equal steps of Adam, so that constant colours predict low bits of harmonics.

See `keyss.channels.quiet.predictability`. Pairs are found by high bits and constant colours. A hit is a
difference of harmonics within 1/16 of a cell (the range of low bits) of a twentieth of that of the constant
colours. The null distribution comes from the same file with other low bits.
"""

from __future__ import annotations

import numpy as np

from keyss.core.arrays import Doubles, Words32, doubles
from keyss.core.gaussians import Gaussians
from keyss.lab.stealth.agreement import nearest_pairs
from keyss.lab.stealth.statistic import ATTRIBUTES, BitPatterns, Statistic, normal

_LOW = np.uint32((1 << 13) - 1)
_RATIO = 20.0  # learning rate of constant colours / harmonics
_NEAREST = 16
_AGREE = 4  # minimum agreeing harmonics of a colour
_PART = 16  # a hit is within cell / 16 of the prediction
_DRAWS, _MAX_DIFFERENCES, _MIN_EXPECTED = 200, 16_000, 5.0


def steps(model: Gaussians, words: BitPatterns) -> dict[str, Statistic]:
    """Excess of hits over random low bits, in standard deviations."""
    harmonics = words.bits[:, words.attribute >= ATTRIBUTES.index("sh1")]
    if not harmonics.shape[1] or len(model) < 2:
        return {}
    constant = doubles(model.sh[:, 0]) / _RATIO
    pairs = nearest_pairs(np.nan_to_num(doubles(model.means)), _NEAREST)
    found = []
    for colour in range(3):
        own = harmonics[:, colour::3]
        for start in range(0, len(pairs), 1 << 16):
            one, other = pairs[start : start + (1 << 16)].T
            moved = np.abs(constant[one, colour] - constant[other, colour])[:, None]
            cell = np.maximum(_cells(own[one]), _cells(own[other]))
            near = np.abs(np.abs(_middle(own[one]) - _middle(own[other])) - moved) <= cell
            near &= moved > 2 * cell  # equal numbers are no evidence
            chosen = np.flatnonzero(near.sum(axis=1) >= _AGREE)
            rows, columns = np.nonzero(near[chosen])
            rows = chosen[rows]
            sides = own[one[rows], columns], own[other[rows], columns]
            found.append((*sides, moved[rows, 0], cell[rows, columns]))
    one, other, moved, cell = (np.concatenate(each)[:_MAX_DIFFERENCES] for each in zip(*found, strict=True))
    hits = _hits(one, other, moved, cell)
    random = np.random.default_rng(0)
    drawn = [_hits(_redrawn(one, random), _redrawn(other, random), moved, cell) for _ in range(_DRAWS)]
    expected = float(np.mean(drawn))
    if expected < _MIN_EXPECTED:
        return {}
    return {"differences of siblings": normal((hits - expected) / max(1.0, float(np.std(drawn))), 1.0)}


def _hits(one: Words32, other: Words32, moved: Doubles, cell: Doubles) -> int:
    off = np.abs(np.abs(_numbers(one) - _numbers(other)) - moved)
    return int((off < cell / _PART).sum())


def _redrawn(words: Words32, random: np.random.Generator) -> Words32:
    new = random.integers(0, 1 << 12, words.shape, np.uint32) << np.uint32(1)
    return words & ~(_LOW - np.uint32(1)) | new


def _numbers(words: Words32) -> Doubles:
    return words.view(np.float32).astype(np.float64)


def _middle(words: Words32) -> Doubles:
    return _numbers(words & ~_LOW | (_LOW + 1) >> 1)


def _cells(words: Words32) -> Doubles:
    """The range of each number's low bits."""
    return 2 * np.abs(_middle(words) - _numbers(words & ~_LOW))
