"""Levels that may be written without a visible trace.

Readers need not know which levels these are (`wet_paper`). Towards a limit that levels may not cross, the
share of writable levels falls gradually, at random: at a sharp border they would pile up. The randomness is
derived from the cover, which only the writer has.

Coincidences are more frequent than by chance. Trainers start with round Gaussians, some with rotations by 0
degrees, and where few views show them they stay nearly so. Clones start with equal rotations and scales.
Writing would destroy these coincidences, so a random subset of each kind stays untouched, as large as the
excess over chance.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np

from keyss.channels.lsb.fields import LOG_SCALE_RANGE, ROTATIONS, Field, Levels, sog_distances
from keyss.channels.mixing import random_fractions
from keyss.core.arrays import Doubles, Flags, Integers
from keyss.core.neighbours import nearest_neighbours
from keyss.files.formats.common import Codes, is_in_morton_order, morton_keys
from keyss.files.formats.compressed_ply import CHUNK, VECTOR, CompressedPlyCodes
from keyss.files.formats.sog import SogCodes
from keyss.files.formats.spz import SpzCodes

# Distance to the nearest neighbour, in sizes of the Gaussian, at which half of the Gaussians are left single.
# Clones lie nearer to each other, and there are more of them than by chance.
_CLONES = 1 / 8
_NEIGHBOURS = 4  # nearest neighbours searched for clones
_RAMP = 3  # width of the ramp before a limit, in units of 2^bits levels
_NEAR = 8  # maximum distance of levels whose frequencies are compared
_EQUAL = 0.02  # excess that is always allowed, as a share of the Gaussians
_BIAS = 0.02  # maximum bias of last bits
_OFF_LATTICE = 0.24  # minimum mean distance from a lattice, in steps; by chance it is 0.248
_ROUGH, _DEVIATIONS = 0.25, 6  # an excess that is ignored: relative, and in standard deviations
_NAMES = ("positions", "rotations", "scales")  # attributes that carry bits in any format
_LEVELS = (0.5, 1.5, 2.5, 3.5, 5.5, 7.5, 15.5)  # upper ends of the bins of differences of levels
# Upper ends of the bins of differences of log scales.
_LOG_SCALES: Doubles = np.exp2(LOG_SCALE_RANGE + np.arange(-6.0, 2.0))


def writable_levels(codes: Codes, fields: list[Field], fixed: Flags, secret: bytes) -> list[Flags]:
    """For each field a mask [N] of the levels that may be written.

    `fixed` [3]: the result of `fixed_axes`. `secret`: 32 secret bytes.
    """
    count = len(fields[0].levels)
    model = codes.dequantise()
    means, log_scales = model.means.double().numpy(), model.log_scales.double().numpy()
    distance, near = nearest_neighbours(means, min(_NEIGHBOURS + 1, count))
    ratio = distance[:, 1] / np.exp(np.median(log_scales, axis=1)) / _CLONES
    single = _not_clones(fields, ratio, near, random_fractions(secret, "kept/clones", count))
    left = _without_excess(codes, fields, log_scales, single, near[:, 1:], secret)
    stable = _keep_largest(codes, fields, random_fractions(secret, "kept/turns", count))
    ordered = _keep_order(codes, fields, means)
    free = []
    for field, writable in zip(fields, left, strict=True):
        random = random_fractions(secret, f"kept/{field.name}/{field.column}", count)
        writable &= field.bits > 0
        writable &= _margin(codes, field) > random * _RAMP * (1 << field.bits)
        if field.name == "rotations":
            writable &= stable
        elif field.name == "positions":
            writable &= ordered & ~fixed[field.column]
        free.append(writable if _is_natural(field.levels[writable]) else np.zeros_like(writable))
    return free


def fixed_axes(codes: Codes) -> Flags:
    """[3] axes along which no position may change. `codes`: in the order of their file.

    Those along which positions are on the lattices of the chunks of a compressed .ply.
    """
    means = codes.dequantise().means.numpy()
    chunks = means[: len(means) // CHUNK * CHUNK].astype(np.float64).reshape(-1, CHUNK, 3)
    low, high = chunks.min(axis=1, keepdims=True), chunks.max(axis=1, keepdims=True)
    levels = (chunks - low) / np.where(high > low, high - low, 1.0) * (2.0 ** np.array(VECTOR) - 1)
    distances = np.abs(levels - np.rint(levels)).reshape(-1, 3)
    expected = _OFF_LATTICE - _DEVIATIONS / (12 * max(1, len(distances))) ** 0.5
    fixed: Flags = distances.sum(axis=0) < expected * len(distances)
    return fixed


@dataclass(frozen=True)
class _Kind:
    """Differences between numbers of a Gaussian or of two neighbours; small ones are coincidences."""

    fields: list[int]  # indices of the fields that stay
    gaps: Doubles  # [P] each the maximum of `dimensions` differences
    ends: Doubles  # [B] upper ends of bins; the frequency in the last one is that by chance
    dimensions: int
    one: Integers  # [P] rows of the Gaussians
    other: Integers | None = None  # [P] of their neighbours, if compared with these


def _without_excess(
    codes: Codes, fields: Sequence[Field], log_scales: Doubles, free: Flags, near: Integers, secret: bytes
) -> list[Flags]:
    """For each field a mask [N] of the Gaussians that may be written, among those that are `free` [N].

    `log_scales` [N, 3]: decoded. `near` [N, K]: nearest neighbours. `secret`: 32 secret bytes.
    """
    left = [free.copy() for _ in fields]
    for index, kind in enumerate(_kinds(codes, fields, log_scales, near)):
        writable, pairs = left[kind.fields[0]], [kind.one] if kind.other is None else [kind.one, kind.other]
        moved = np.flatnonzero(np.any([writable[rows] for rows in pairs], axis=0))
        random = random_fractions(secret, f"kept/excess/{index}", len(moved))
        stays = moved[random < _excess_share(kind.gaps[moved], kind.ends, kind.dimensions)]
        for field, rows in product(kind.fields, pairs):
            left[field][rows[stays]] = False
    return left


def _kinds(codes: Codes, fields: Sequence[Field], log_scales: Doubles, near: Integers) -> Iterator[_Kind]:
    """Equal coordinates of neighbours, small and equal parts of rotations, round Gaussians, and clones."""
    every = np.arange(len(near))
    one, other = np.repeat(every, near.shape[1]), near.ravel()
    at = {name: [index for index, field in enumerate(fields) if field.name == name] for name in _NAMES}
    for index in at["positions"]:
        levels, bits = fields[index].levels, fields[index].bits
        free = np.flatnonzero((bits[one] > 0) & (bits[other] > 0))
        gaps = np.abs(levels[one[free]] - levels[other[free]]).astype(np.float64)
        yield _Kind([index], gaps, np.array(_LEVELS[:4]), 1, one[free], other[free])
    if columns := at["rotations"]:
        turns = np.stack([fields[index].levels for index in columns], axis=1).astype(np.float64)
        ends = np.array(_LEVELS[: 5 + 2 * int(fields[columns[0]].bits.max() > 2)])
        parts = np.abs(turns - sum(ROTATIONS[type(codes)]) / 2)
        from_zero = ends + parts.flat[0] % 1  # the middle lies between two levels in some formats
        for part in parts.T:
            yield _Kind(columns, part, from_zero, 1, every)
        yield _Kind(columns, parts.max(axis=1), from_zero, 3, every)
        for a, b in combinations(parts.T, 2):
            yield _Kind(columns, np.abs(a - b), ends, 1, every)
        same = np.flatnonzero(codes.largest[one] == codes.largest[other])  # type: ignore[attr-defined]
        gaps = np.abs(turns[one[same]] - turns[other[same]]).max(axis=1)
        yield _Kind(columns, gaps, ends, 3, one[same], other[same])
    if columns := at["scales"]:
        for a, b in combinations(log_scales.T, 2):
            yield _Kind(columns, np.abs(a - b), _LOG_SCALES, 1, every)
        yield _Kind(columns, log_scales.max(axis=1) - log_scales.min(axis=1), _LOG_SCALES, 2, every)
        yield _Kind(
            columns, np.abs(log_scales[one] - log_scales[other]).max(axis=1), _LOG_SCALES, 3, one, other
        )


def _excess_share(gaps: Doubles, ends: Doubles, dimensions: int) -> Doubles:
    """[P] the share of the gaps in the same bin that is more than by chance; 0 for little."""
    edges = np.append(0.0, ends)
    counts, volumes = np.histogram(gaps, edges)[0], np.diff(edges**dimensions)
    expected = counts[-1] / volumes[-1] * volumes
    large = counts - expected > np.maximum(_ROUGH * expected, _DEVIATIONS * expected**0.5)
    share = np.where(large, 1 - expected / np.maximum(counts, 1), 0.0)
    shares: Doubles = np.append(share, 0.0)[np.searchsorted(ends, gaps)]
    return shares


def _keep_order(codes: Codes, fields: list[Field], means: Doubles) -> Flags:
    """[N] which positions can change without a new place in a file in Morton order.

    Such an .spz would be less in order than rounding explains. (A .sog is sorted again.)
    """
    if not isinstance(codes, SpzCodes) or not is_in_morton_order(means.astype(np.float32)):
        return np.ones(len(means), np.bool_)
    reach = np.stack([field.reach for field in fields if field.name == "positions"], axis=1)
    least, largest = (
        morton_keys(means + sign * reach * 2.0**-codes.fractional_bits, means) for sign in (-1, 1)
    )
    crosses = largest[:-1] > least[1:]
    kept: Flags = ~(np.append(crosses, False) | np.append(False, crosses))
    return kept


def _not_clones(fields: list[Field], ratio: Doubles, near: Integers, random: Doubles) -> Flags:
    """[N] which Gaussians are not clones. `ratio` [N]: nearest distance / size / `_CLONES`.

    Training moves clones apart slowly, so there are more near pairs than by chance, and writing would move
    them further apart. The share of writable Gaussians grows smoothly with the distance from the nearest
    neighbour, relative to their size. Gaussians that share a written attribute with a neighbour never change.
    """
    both = np.minimum(np.arange(len(near)), near[:, 1])  # mutual nearest neighbours share one decision
    single: Flags = random[both] * (1 + ratio**3) < ratio**3
    for name in {field.name for field in fields}:
        levels = np.stack([field.levels for field in fields if field.name == name], axis=1)
        single &= ~(levels[near[:, 1:]] == levels[:, None]).all(axis=2).any(axis=1)
    return single


def _margin(codes: Codes, field: Field) -> Doubles:
    """[N] levels between the nearest limit and the range that writing reaches; negative if it crosses."""
    least, largest = field.levels.min(), field.levels.max()
    if field.name == "rotations":
        least, largest = ROTATIONS[type(codes)]
    elif isinstance(codes, CompressedPlyCodes):
        least, largest = 0, (2047, 1023, 2047)[field.column]
    margin: Doubles = np.minimum(field.levels - least, largest - field.levels) - 1.0
    if isinstance(codes, SogCodes) and field.name == "positions":
        margin = np.minimum(margin, _to_next_distance(codes, field))
    return margin - field.reach


def _to_next_distance(codes: SogCodes, field: Field) -> Doubles:
    """[N] distance of each level from the nearest change of `sog_distances`, which determines `bits`."""
    every = np.zeros((65536, 3), np.int64)
    every[:, field.column] = np.arange(65536)
    borders = np.flatnonzero(np.diff(sog_distances(codes, every)[:, field.column])) + 0.5
    borders = np.concatenate([[-np.inf], borders, [np.inf]])
    after = np.searchsorted(borders, field.levels)
    gaps: Doubles = np.minimum(field.levels - borders[after - 1], borders[after] - field.levels) - 0.5
    return gaps


def _keep_largest(codes: Codes, fields: list[Field], random: Doubles) -> Flags:
    """[N] which rotations keep their largest component, the one that is not stored."""
    rotations = [field for field in fields if field.name == "rotations"]
    if not rotations:
        return np.ones(len(random), np.bool_)
    least, largest = ROTATIONS[type(codes)]
    parts = np.abs(np.stack([field.levels for field in rotations], axis=1) - (least + largest) / 2)
    parts += np.stack([field.reach for field in rotations], axis=1)
    rest = np.sqrt(np.maximum(0.0, (largest - least) ** 2 / 2 - np.square(parts).sum(axis=1)))
    stable: Flags = rest - parts.max(axis=1) > random * _RAMP * (1 << rotations[0].bits)
    return stable


def _is_natural(levels: Levels) -> bool:
    """True if matching leaves no trace in levels [N].

    Pairs of equal levels are about as frequent as pairs of near ones, and even levels as odd ones.
    """
    if len(levels) < 2:
        return True
    values, counts = np.unique(levels.astype(np.int64), return_counts=True)
    counts = counts.astype(np.int64)
    equal = float((counts * (counts - 1)).sum())
    near = [_pairs(values, counts, distance) for distance in range(1, _NEAR + 1)]
    expected = float(np.mean(near))
    if equal - expected > max(_ROUGH * expected, _EQUAL * len(levels), _DEVIATIONS * expected**0.5):
        return False
    odd = float((levels & 1).mean())
    return bool(abs(odd - 0.5) < _BIAS + _DEVIATIONS / 2 / len(levels) ** 0.5)


def _pairs(values: Integers, counts: Integers, distance: int) -> float:
    """The number of pairs of levels that differ by `distance`."""
    at = np.searchsorted(values, values + distance).clip(max=len(values) - 1)
    there = values[at] == values + distance
    return float((counts[there] * counts[at[there]]).sum())
