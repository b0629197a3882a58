"""Levels that writers leave as they are because a change would show; readers need not know (`syndromes`).

Near a limit that levels may not cross, fewer and fewer of them change, at random: with a sharp border they
would pile up behind it. The randomness follows from the cover, which only the writer has.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from keyss.channels.codes.fields import Doubles, Field, Flags, Levels, format_of, sog_distances
from keyss.channels.codes.matching import reach
from keyss.channels.mixing import random_fractions
from keyss.files.formats.common import Codes
from keyss.files.formats.compressed_ply import CompressedPlyCodes
from keyss.files.formats.sog import SogCodes

# In sizes of the Gaussian: at this distance from its nearest neighbour half of them are left alone. Clones
# lie nearer to each other, and more of them than there would be by chance.
_CLONES = 1 / 8
_NEIGHBOURS = 4  # of a Gaussian, among which its clones are
_RAMP = 3  # ranges of what is written
_NEAR = 8  # levels away, whose frequencies are compared
_ROUGH = 0.25  # by how much more often levels may be equal than near each other
_EQUAL = 0.02  # as a share of the Gaussians
_DEVIATIONS = 6
_LEANING = 0.02  # of the last bits to 0 or to 1

Integers = npt.NDArray[np.int64]


def changeable(codes: Codes, fields: list[Field], secret: bytes) -> list[Flags]:
    """Of each field the levels [N] that may be changed. `secret`: 32 secret bytes."""
    count = len(fields[0].levels)
    alone = _alone(codes, fields, random_fractions(secret, "kept/clones", count))
    turnable = _turnable(codes, fields, random_fractions(secret, "kept/turns", count))
    found = []
    for field in fields:
        random = random_fractions(secret, f"kept/{field.name}/{field.column}", count)
        own = alone & (_room(codes, field) > random * _RAMP * (1 << field.bits)) & (field.bits > 0)
        if field.name == "rotations":
            own &= turnable
        found.append(own if is_natural(field.levels[own]) else np.zeros_like(own))
    return found


def _alone(codes: Codes, fields: list[Field], random: Doubles) -> Flags:
    """[N] which Gaussians lie where by chance one would lie: not clones, some of which move apart slowly.

    Of pairs that are near to each other, few change, for there are more of them than by chance, and these
    would move apart; with the distance, in sizes of the Gaussian, the share grows smoothly. None changes
    that has a written attribute in common with a neighbour.
    """
    model = format_of(codes).dequantise(codes)
    means, log_scales = (each.double().numpy() for each in (model.means, model.log_scales))
    sizes = np.exp(np.sort(log_scales, axis=1)[:, 1])
    distance, near = cKDTree(means).query(means, k=min(_NEIGHBOURS + 1, len(means)))
    ratio = distance[:, 1] / sizes / _CLONES
    both = np.minimum(np.arange(len(means)), near[:, 1])  # of two nearest to each other, both or none
    found: Flags = random[both] * (1 + ratio**3) < ratio**3
    for name in {each.name for each in fields}:
        levels = np.stack([each.levels for each in fields if each.name == name], axis=1)
        found &= ~(levels[near[:, 1:]] == levels[:, None]).all(axis=2).any(axis=1)
    return found


def _room(codes: Codes, field: Field) -> Doubles:
    """[N] how many levels lie between those that a level may become and what it may not; negative: none."""
    least, most = field.levels.min(), field.levels.max()
    if field.name == "rotations":
        least, most = {"spz": (-511, 511), "sog": (0, 255)}.get(format_of(codes).name, (0, 1023))
        if getattr(codes, "version", 3) == 2:
            least, most = 0, 255
    elif isinstance(codes, CompressedPlyCodes):
        least, most = 0, (2047, 1023, 2047)[field.column]
    ends = np.minimum(field.levels - least, most - field.levels)
    found: Doubles = (ends - 1 - reach(field.bits)).astype(np.float64)
    if isinstance(codes, SogCodes) and field.name == "positions":
        found = np.minimum(found, _within_distances(codes, field))
    return found


def _within_distances(codes: SogCodes, field: Field) -> Doubles:
    """[N] the same for the levels at which `sog_distances`, on which bits depend, changes."""
    every = np.zeros((65536, 3), np.int64)
    every[:, field.column] = np.arange(65536)
    powers = sog_distances(codes, every)[:, field.column]
    borders = np.flatnonzero(np.diff(powers)) + 0.5
    if not len(borders):
        return np.full(len(field.levels), np.inf)
    after = np.searchsorted(borders, field.levels)
    gaps = np.stack(
        [
            field.levels - borders[(after - 1).clip(0)],
            borders[after.clip(max=len(borders) - 1)] - field.levels,
        ]
    )
    found: Doubles = np.abs(gaps).min(axis=0) - 0.5 - reach(field.bits)
    return found


def _turnable(codes: Codes, fields: list[Field], random: Doubles) -> Flags:
    """[N] which rotations have no part that could become larger than the one left out as the largest."""
    turns = format_of(codes).turns(codes)
    own = [each for each in fields if each.name == "rotations"]
    if turns is None:
        return np.ones(len(random), np.bool_)
    centre, step = turns
    parts = np.abs(np.stack([each.levels for each in own], axis=1) - centre)
    parts += np.stack([reach(each.bits) for each in own], axis=1)
    rest = np.sqrt(np.maximum(0.0, step**-2 - np.square(parts).sum(axis=1)))
    found: Flags = rest - parts.max(axis=1) > random * _RAMP * (1 << own[0].bits)
    return found


def is_natural(levels: Levels) -> bool:
    """Whether matching would not show: levels are not shared by many Gaussians, and not on a lattice.

    Equal levels are not much more frequent than neighbouring ones, nor even more than odd ones.
    """
    if len(levels) < 2:
        return True
    values, found = np.unique(levels.astype(np.int64), return_counts=True)
    counts = found.astype(np.int64)
    equal = float((counts * (counts - 1)).sum())
    near = [_pairs(values, counts, distance) for distance in range(1, _NEAR + 1)]
    expected = float(np.mean(near))
    if equal - expected > max(_ROUGH * expected, _EQUAL * len(levels), _DEVIATIONS * expected**0.5):
        return False
    odd = float((levels & 1).mean())
    return bool(abs(odd - 0.5) < _LEANING + _DEVIATIONS / 2 / len(levels) ** 0.5)


def _pairs(values: Integers, counts: Integers, distance: int) -> float:
    """How many ordered pairs of levels differ by `distance`, upwards."""
    at = np.searchsorted(values, values + distance).clip(max=len(values) - 1)
    there = values[at] == values + distance
    return float((counts[there] * counts[at[there]]).sum())
