"""Coincidences of codes that are more frequent than by chance.

Trainers start with round Gaussians, some with rotations by 0 degrees, and where few views show them they stay
nearly so. Clones start with equal rotations and scales. Writing would spread all of these. Of each kind of
coincidence a random part stays, the excess over chance: writing makes as many of the others as it spreads.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np

from keyss.channels.mixing import random_fractions
from keyss.channels.quiet.fields import LOG_SCALE_RANGE, Field, carrying
from keyss.core.arrays import Doubles, Flags, Integers
from keyss.files.formats.common import Codes

ROUGH = 0.25  # relative excess that is ignored
DEVIATIONS = 6  # of an excess by chance, in standard deviations
_NAMES = ("positions", "rotations", "scales")  # attributes that carry bits in any format
_LEVELS = (0.5, 1.5, 2.5, 3.5, 5.5, 7.5, 15.5)  # upper ends of the bins of differences of levels
_LOG_SCALES: Doubles = np.exp2(LOG_SCALE_RANGE + np.arange(-6.0, 2.0))  # and of log scales


@dataclass(frozen=True)
class _Kind:
    """Differences between numbers of a Gaussian or of two neighbours; small ones are coincidences."""

    fields: list[int]  # indices of the fields that stay
    gaps: Doubles  # [P] each the maximum of `dimensions` differences
    ends: Doubles  # [B] upper ends of bins; the frequency in the last one is that by chance
    dimensions: int
    one: Integers  # [P] rows of the Gaussians
    other: Integers | None = None  # [P] of their neighbours, if compared with these


def without_excess(
    codes: Codes, fields: Sequence[Field], log_scales: Doubles, free: Flags, near: Integers, secret: bytes
) -> list[Flags]:
    """For each field a mask [N] of the Gaussians that may be written, among those that are `free` [N].

    `log_scales` [N, 3]: decoded. `near` [N, K]: nearest neighbours. `secret`: 32 secret bytes.
    """
    left = [free.copy() for _ in fields]
    for index, kind in enumerate(_kinds(codes, fields, log_scales, near)):
        own, pairs = left[kind.fields[0]], [kind.one] if kind.other is None else [kind.one, kind.other]
        moved = np.flatnonzero(np.any([own[rows] for rows in pairs], axis=0))
        random = random_fractions(secret, f"kept/excess/{index}", len(moved))
        stays = moved[random < _excess_share(kind.gaps[moved], kind.ends, kind.dimensions)]
        for field, rows in product(kind.fields, pairs):
            left[field][rows[stays]] = False
    return left


def _kinds(codes: Codes, fields: Sequence[Field], log_scales: Doubles, near: Integers) -> Iterator[_Kind]:
    """Equal coordinates of neighbours, small and equal parts of rotations, round Gaussians, and clones."""
    every = np.arange(len(near))
    one, other = np.repeat(every, near.shape[1]), near.ravel()
    at = {name: [index for index, each in enumerate(fields) if each.name == name] for name in _NAMES}
    for index in at["positions"]:
        levels, bits = fields[index].levels, fields[index].bits
        free = np.flatnonzero((bits[one] > 0) & (bits[other] > 0))
        gaps = np.abs(levels[one[free]] - levels[other[free]]).astype(np.float64)
        yield _Kind([index], gaps, np.array(_LEVELS[:4]), 1, one[free], other[free])
    if own := at["rotations"]:
        turns = np.stack([fields[index].levels for index in own], axis=1).astype(np.float64)
        ends = np.array(_LEVELS[: 5 + 2 * int(fields[own[0]].bits.max() > 2)])
        parts = np.abs(turns - sum(carrying(codes).rotations) / 2)
        from_zero = ends + parts.flat[0] % 1  # the middle lies between two levels in some formats
        for part in parts.T:
            yield _Kind(own, part, from_zero, 1, every)
        yield _Kind(own, parts.max(axis=1), from_zero, 3, every)
        for a, b in combinations(parts.T, 2):
            yield _Kind(own, np.abs(a - b), ends, 1, every)
        same = np.flatnonzero(codes.largest[one] == codes.largest[other])  # type: ignore[attr-defined]
        gaps = np.abs(turns[one[same]] - turns[other[same]]).max(axis=1)
        yield _Kind(own, gaps, ends, 3, one[same], other[same])
    if own := at["scales"]:
        for a, b in combinations(log_scales.T, 2):
            yield _Kind(own, np.abs(a - b), _LOG_SCALES, 1, every)
        yield _Kind(own, log_scales.max(axis=1) - log_scales.min(axis=1), _LOG_SCALES, 2, every)
        yield _Kind(own, np.abs(log_scales[one] - log_scales[other]).max(axis=1), _LOG_SCALES, 3, one, other)


def _excess_share(gaps: Doubles, ends: Doubles, dimensions: int) -> Doubles:
    """[P] the share of the gaps in the same bin that is more than by chance; 0 for little."""
    edges = np.append(0.0, ends)
    counts, volumes = np.histogram(gaps, edges)[0], np.diff(edges**dimensions)
    expected = counts[-1] / volumes[-1] * volumes
    large = counts - expected > np.maximum(ROUGH * expected, DEVIATIONS * expected**0.5)
    share = np.where(large, 1 - expected / np.maximum(counts, 1), 0.0)
    found: Doubles = np.append(share, 0.0)[np.searchsorted(ends, gaps)]
    return found
