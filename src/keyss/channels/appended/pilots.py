"""Pilots: appended Gaussians that everybody can read. They give the salt and the own frame.

A public hash of a word's 39 invariant bits decides whether it is a pilot: some are written as pilots, and one
random word in 64 is one. The hash also gives a pilot's position and rotation in the own frame. RANSAC
(Fischler and Bolles 1981; least squares by Umeyama 1991) finds the similarity on which most pilots agree. It
maps a moved, rotated or scaled model back to that frame.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
import torch

from keyss.channels.appended.words import (
    COLOUR_BITS,
    INVARIANT_BITS,
    POSITION_BITS,
    ROTATION_BITS,
    SCALE_BITS,
    bits_of,
)
from keyss.channels.mixing import mix
from keyss.core.arrays import Bits, Doubles, Flags, Integers, Words
from keyss.core.similarity import Similarity
from keyss.keys.derivation import SALT_BYTES

MIN = 128  # minimum number of pilots per model
SHARE = 1 / 33  # pilots per appended Gaussian
_PUBLIC = np.uint64(0x6B65797373_617070)  # domain separation of the hash
ONE_IN = 64  # words per accidental pilot
_PART_BITS, _PARTS = 16, SALT_BYTES // 2
_RANDOM_BITS = 3 * COLOUR_BITS - 3 - _PART_BITS  # random bits of a pilot
_TRIES, _MIN_INLIERS = 300, 12  # triples of pilots to try; inliers of a valid similarity
_SAMPLE = 1024  # pilots to try first, which bounds the time if most are outliers
_NEAR = 1.5 / 2**POSITION_BITS  # maximum distance of an inlier from its place, in the own frame


@dataclass(frozen=True)
class PilotFit:
    """Frame and salt from all pilots."""

    to_own: Similarity  # world to own frame
    inliers: int
    salt: bytes


def count_for(appended: int) -> int:
    """The number of pilots among `appended` Gaussians."""
    return max(MIN, round(appended * SHARE))


def write(salt: bytes, count: int, random: np.random.Generator) -> Bits:
    """Words [count, WORD_BITS] of pilots."""
    parts = np.frombuffer(salt, ">u2").astype(np.uint64)
    which = np.arange(count) % _PARTS
    pilots = np.zeros(count, np.uint64)
    missing = np.arange(count)
    while len(missing):
        scales = random.integers(0, 1 << 3 * SCALE_BITS, len(missing), np.uint64)
        filling = random.integers(0, 1 << _RANDOM_BITS, len(missing), np.uint64)
        values = which[missing].astype(np.uint64) << np.uint64(_PART_BITS) | parts[which[missing]]
        colours = (values << np.uint64(_RANDOM_BITS) | filling) ^ _whitening(scales)
        invariants = colours << np.uint64(3 * SCALE_BITS) | scales
        good = _is_pilot(invariants)
        pilots[missing[good]] = invariants[good]
        missing = missing[~good]
    places = mix(mix(pilots ^ _PUBLIC))
    width = 3 * (POSITION_BITS + ROTATION_BITS)
    others = bits_of(places >> np.uint64(64 - width), width)
    return np.concatenate([bits_of(pilots, INVARIANT_BITS), others], axis=1)


def read(invariants: Words, means: Doubles) -> PilotFit | None:
    """Fit the pilots among candidates with `invariants` [N] and `means` [N, 3] in the world.

    None if too few agree.
    """
    random = np.random.default_rng(0)
    pilots = find(invariants)
    if len(pilots) < _MIN_INLIERS:
        return None
    places = mix(mix(invariants[pilots] ^ _PUBLIC))
    shifts = np.uint64(64) - np.arange(1, 4, dtype=np.uint64) * np.uint64(POSITION_BITS)
    points = places[:, None] >> shifts & np.uint64(2**POSITION_BITS - 1)
    expected = (points.astype(np.float64) + 0.5) / 2**POSITION_BITS
    world = means[pilots]
    some = np.arange(min(len(pilots), _SAMPLE)) * len(pilots) // min(len(pilots), _SAMPLE)
    triples = some[random.integers(0, len(some), (_TRIES, 3))]
    inliers = _inliers(world, expected, triples, some)
    best = some[inliers[inliers.sum(axis=1).argmax()]]
    for _ in range(3):
        if len(best) >= _MIN_INLIERS:
            best = np.flatnonzero(_inliers(world, expected, best))
    salt = _salt(invariants[pilots[best]]) if len(best) >= _MIN_INLIERS else None
    if salt is None:
        return None
    scale, rotation, translation = _similarities(world[best], expected[best])
    to_own = Similarity(float(scale), torch.from_numpy(rotation), torch.from_numpy(translation))
    return PilotFit(to_own, len(best), salt)


def _inliers(
    world: Doubles, expected: Doubles, chosen: Integers, among: Integers | slice = slice(None)
) -> Flags:
    """Masks [..., A] of the pilots `among` all that the similarity fitted to `chosen` [..., P] maps to their
    positions.
    """
    scales, rotations, translations = _similarities(world[chosen], expected[chosen])
    turned = world[among] @ rotations.swapaxes(-1, -2)
    off = scales[..., None, None] * turned + translations[..., None, :] - expected[among]
    near: Flags = (np.abs(off) < _NEAR).all(axis=-1)
    return near


def _similarities(source: Doubles, target: Doubles) -> tuple[Doubles, Doubles, Doubles]:
    """Least-squares similarities from `source` [..., P, 3] to `target` (Umeyama 1991).

    Scales [...], NaN for degenerate points, rotations [..., 3, 3] and translations [..., 3].
    """
    centre, goal = source.mean(axis=-2), target.mean(axis=-2)
    a, b = source - centre[..., None, :], target - goal[..., None, :]
    spread = np.square(a).sum(axis=(-2, -1))
    good = np.isfinite(spread) & (spread > 0)
    u, values, v = np.linalg.svd(np.where(good[..., None, None], b.swapaxes(-1, -2) @ a, 0))
    signs = np.sign(np.linalg.det(u @ v))[..., None]
    u[..., 2] *= signs  # no reflection
    values[..., 2:] *= signs
    total = values.sum(axis=-1)
    scales = np.where(good & (total > 0), total, np.nan) / np.where(good, spread, 1)
    rotations = u @ v
    translations = goal - scales[..., None] * (rotations @ centre[..., None])[..., 0]
    return scales, rotations, translations


def _salt(invariants: Words) -> bytes | None:
    """The salt by majority for each part; None if a part has no pilot left."""
    scales = invariants & np.uint64((1 << 3 * SCALE_BITS) - 1)
    parts = (invariants >> np.uint64(3 * SCALE_BITS) ^ _whitening(scales)) >> np.uint64(_RANDOM_BITS)
    votes = [Counter[int]() for _ in range(_PARTS)]
    for part in parts.tolist():
        votes[part >> _PART_BITS][part & (1 << _PART_BITS) - 1] += 1
    if not all(votes):
        return None
    return b"".join(counter.most_common(1)[0][0].to_bytes(2, "big") for counter in votes)


def find(invariants: Words) -> Integers:
    """Rows of different pilots among `invariants` [N]; copies of one would outnumber the others."""
    places = np.flatnonzero(_is_pilot(invariants))
    return places[np.sort(np.unique(invariants[places], return_index=True)[1])]


def _is_pilot(invariants: Words) -> Flags:
    pilot: Flags = mix(invariants ^ _PUBLIC) & np.uint64(ONE_IN - 1) == 0
    return pilot


def _whitening(scales: Words) -> Words:
    """Masks [N] of 21 bits that make the colours of pilots look random."""
    return mix(scales ^ _PUBLIC) >> np.uint64(64 - 3 * COLOUR_BITS)
