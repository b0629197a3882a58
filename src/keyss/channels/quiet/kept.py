"""Levels that a writer leaves alone because a change would show, and the orders of Gaussians.

Readers need not know which levels these are (`syndromes`). Near a limit that levels may not cross, fewer and
fewer of them change, at random: behind a sharp border they would pile up. The randomness follows from the
cover, which only the writer has.

Gaussians have an order in which bits are counted, and the one of the file.
Formats whose order does not depend on written codes keep it. A .sog is sorted by `in_morton_order`; its bits
are counted in an order of codes that are not written.
"""

from __future__ import annotations

import hashlib
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from keyss.channels.mixing import random_fractions, row_hashes
from keyss.channels.quiet.fields import Field, Levels, carrying, sog_distances
from keyss.channels.quiet.usable import repeated
from keyss.core.arrays import Doubles, Flags, Floats, Integers, Words
from keyss.core.gaussians import Gaussians
from keyss.core.neighbours import nearest_neighbours
from keyss.files.formats.common import Codes, morton_order
from keyss.files.formats.compressed_ply import CompressedPlyCodes
from keyss.files.formats.sog import SogCodes

# Distance to the nearest neighbour, in sizes of the Gaussian, at which half of the Gaussians are left alone.
# Clones lie nearer to each other, and there are more of them than by chance.
_CLONES = 1 / 8
_NEIGHBOURS = 4  # of a Gaussian, among which its clones are
_RAMP = 3  # width of the ramp before a limit, in ranges of written levels
_NEAR = 8  # levels away, whose frequencies are compared
_ROUGH = 0.25  # by how much more often levels may be equal than near each other
_EQUAL = 0.02  # as a share of the Gaussians
_DEVIATIONS = 6
_LEANING = 0.02  # of the last bits to 0 or to 1
_SOG_ARRAYS = ("positions", "largest", "rotations", "scales", "colors", "alphas", "labels")


def changeable(codes: Codes, fields: list[Field], secret: bytes) -> list[Flags]:
    """The levels [N] of each field that may be changed. `secret`: 32 secret bytes."""
    count = len(fields[0].levels)
    alone = _alone(codes, fields, random_fractions(secret, "kept/clones", count))
    turnable = _turnable(codes, fields, random_fractions(secret, "kept/turns", count))
    free = []
    for field in fields:
        random = random_fractions(secret, f"kept/{field.name}/{field.column}", count)
        own = alone & (_room(codes, field) > random * _RAMP * (1 << field.bits)) & (field.bits > 0)
        if field.name == "rotations":
            own &= turnable
        free.append(own if _is_natural(field.levels[own]) else np.zeros_like(own))
    return free


def _alone(codes: Codes, fields: list[Field], random: Doubles) -> Flags:
    """[N] which Gaussians are no clones.

    Training moves clones apart slowly, so there are more near pairs than by chance, and changes would move
    them further: the share of those that change grows smoothly with the distance in sizes of the Gaussian. A
    Gaussian that has a written attribute in common with a neighbour never changes.
    """
    model = codes.dequantise()
    means, log_scales = (each.double().numpy() for each in (model.means, model.log_scales))
    sizes = np.exp(np.sort(log_scales, axis=1)[:, 1])
    distance, near = nearest_neighbours(means, min(_NEIGHBOURS + 1, len(means)))
    ratio = distance[:, 1] / sizes / _CLONES
    both = np.minimum(np.arange(len(means)), near[:, 1])  # of two nearest to each other, both or none
    alone: Flags = random[both] * (1 + ratio**3) < ratio**3
    for name in {each.name for each in fields}:
        levels = np.stack([each.levels for each in fields if each.name == name], axis=1)
        alone &= ~(levels[near[:, 1:]] == levels[:, None]).all(axis=2).any(axis=1)
    return alone


def _room(codes: Codes, field: Field) -> Doubles:
    """[N] how many levels lie between the reach of each and the nearest limit; negative for none."""
    least, largest = field.levels.min(), field.levels.max()
    if field.name == "rotations":
        least, largest = carrying(codes).rotations
    elif isinstance(codes, CompressedPlyCodes):
        least, largest = 0, (2047, 1023, 2047)[field.column]
    room: Doubles = np.minimum(field.levels - least, largest - field.levels) - 1.0
    if isinstance(codes, SogCodes) and field.name == "positions":
        room = np.minimum(room, _to_next_distance(codes, field))
    return room - field.reach


def _to_next_distance(codes: SogCodes, field: Field) -> Doubles:
    """[N] how far each level is from where `sog_distances` changes, on which numbers of bits depend."""
    every = np.zeros((65536, 3), np.int64)
    every[:, field.column] = np.arange(65536)
    borders = np.flatnonzero(np.diff(sog_distances(codes, every)[:, field.column])) + 0.5
    borders = np.concatenate([[-np.inf], borders, [np.inf]])
    after = np.searchsorted(borders, field.levels)
    gaps: Doubles = np.minimum(field.levels - borders[after - 1], borders[after] - field.levels) - 0.5
    return gaps


def _turnable(codes: Codes, fields: list[Field], random: Doubles) -> Flags:
    """[N] which rotations have no part that could become larger than the one that is not stored."""
    own = [each for each in fields if each.name == "rotations"]
    if not own:
        return np.ones(len(random), np.bool_)
    least, largest = carrying(codes).rotations
    parts = np.abs(np.stack([each.levels for each in own], axis=1) - (least + largest) / 2)
    parts += np.stack([each.reach for each in own], axis=1)
    rest = np.sqrt(np.maximum(0.0, (largest - least) ** 2 / 2 - np.square(parts).sum(axis=1)))
    turnable: Flags = rest - parts.max(axis=1) > random * _RAMP * (1 << own[0].bits)
    return turnable


def _is_natural(levels: Levels) -> bool:
    """True if matching leaves no trace: few Gaussians share a level, and levels lie on no lattice.

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


def in_counted_order(codes: Codes, exact: Flags | None = None) -> tuple[Integers, Any, list[Field]]:
    """The order [N] in which bits are counted, the codes in it, and their fields.

    Gaussians that are not `exact` [N] (see `Decoded`) carry nothing, nor do those of a .sog that are alike in
    all codes that are not written.
    """
    rows = np.arange(len(codes))
    silent = np.zeros(len(codes), np.bool_) if exact is None else ~exact
    if isinstance(codes, SogCodes):
        names = _sog_names(codes)
        rows, silent = np.argsort(names, kind="stable"), silent | repeated(names)
    codes, silent = in_rows(codes, rows), silent[rows]
    fields = carrying(codes).fields(codes)
    return rows, codes, [replace(each, bits=np.where(silent, 0, each.bits)) for each in fields]


def host_of(codes: Any, decoded: Gaussians | None = None) -> bytes:
    """12 bytes of a hash of colours and opacities, which are never written; those of the model if `decoded`.

    So that the blocks of one model, which everybody can read, are of no use in another one. Both in the order
    in which bits are counted. Gaussians of a .sog that are alike count for nothing, as in that order.
    """
    if decoded is None:
        words = np.column_stack([codes.colors, codes.alphas]).astype("<u4")
    else:
        words = torch.column_stack([decoded.sh[:, 0], decoded.opacity_logits]).float().numpy().view("<u4")
    if isinstance(codes, SogCodes):
        words = words[~repeated(_sog_names(codes))]
    return hashlib.sha256(b"keyss/v1/host" + words.tobytes()).digest()[:12]


def file_order(codes: Codes, within: Doubles) -> Integers:
    """The rows [N] as a writer of the format sorts them.

    It sorts before it rounds, so that a few neighbours seem to be out of order. `within` [N, 3], random in
    [-0.5, 0.5]: how far above their levels the numbers were. Extremes lie on their levels.
    """
    if not isinstance(codes, SogCodes):
        return np.arange(len(codes))
    levels = codes.positions
    extreme = (levels == levels.min(axis=0)) | (levels == levels.max(axis=0))
    means: Floats = codes.positions_at(levels + np.where(extreme, 0.0, within)).astype(np.float32)
    return morton_order(means)


def in_rows(codes: Codes, rows: Integers) -> Any:
    """The Gaussians of `codes` in another order; only those of a .sog have one of their own."""
    if not isinstance(codes, SogCodes):
        return codes
    return replace(codes, **{name: getattr(codes, name)[rows] for name in _SOG_ARRAYS})


def _sog_names(codes: SogCodes) -> Words:
    """[N] hashes of codes that are not written. Where two are equal by chance, a little room is lost."""
    parts = (codes.scales, codes.colors, codes.alphas, codes.labels, codes.largest)
    levels = sog_distances(codes, codes.positions)
    return row_hashes(np.concatenate([each.reshape(len(levels), -1) for each in (*parts, levels)], axis=1))
