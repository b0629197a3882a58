"""Pilots: appended Gaussians that everybody can read. They tell the salt, and where the own frame is.

A public hash of the 39 bits that no similarity changes decides whether a word is a pilot: one random word in
64 is, and some are written. The hash also gives a pilot's position and rotation in the own frame. However a
model was moved, rotated and scaled, the similarity that most pilots agree on leads back to that frame
(RANSAC, Fischler and Bolles 1981; least squares by Umeyama 1991).
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
    SCALE_BITS,
    TURN_BITS,
    bits_of,
)
from keyss.channels.mixing import mixed
from keyss.core.arrays import Bits, Doubles, Flags, Integers, Words
from keyss.core.similarity import Similarity
from keyss.keys.derivation import SALT_BYTES

MIN = 128  # pilots of a model
SHARE = 1 / 33  # of the appended Gaussians
_PUBLIC = np.uint64(0x6B65797373_617070)  # distinguishes this hash from others
ONE_IN = 64  # one in so many random words is a pilot
_PART_BITS, _PARTS = 16, SALT_BYTES // 2
_RANDOM_BITS = 3 * COLOUR_BITS - 3 - _PART_BITS  # beside the part of the salt and its number
_TRIES, _AGREE = 300, 12  # of three pilots; that have to agree
_SAMPLE = 1024  # pilots that are tried first, so that many that disagree cost no more than few
_NEAR = 1.5 / 2**POSITION_BITS  # in the own frame


@dataclass(frozen=True)
class Found:
    """The common result of all pilots."""

    to_own: Similarity  # from the world to the own frame
    agreeing: int  # pilots
    salt: bytes


def count_for(appended: int) -> int:
    """How many of so many appended Gaussians are pilots."""
    return max(MIN, round(appended * SHARE))


def write(salt: bytes, count: int, random: np.random.Generator) -> Bits:
    """[count, WORD_BITS] words of pilots."""
    parts = np.frombuffer(salt, ">u2").astype(np.uint64)
    which = np.arange(count) % _PARTS
    found = np.zeros(count, np.uint64)
    missing = np.arange(count)
    while len(missing):
        scales = random.integers(0, 1 << 3 * SCALE_BITS, len(missing), np.uint64)
        filling = random.integers(0, 1 << _RANDOM_BITS, len(missing), np.uint64)
        own = which[missing].astype(np.uint64) << np.uint64(_PART_BITS) | parts[which[missing]]
        colours = (own << np.uint64(_RANDOM_BITS) | filling) ^ _whitening(scales)
        invariants = colours << np.uint64(3 * SCALE_BITS) | scales
        good = _is_pilot(invariants)
        found[missing[good]] = invariants[good]
        missing = missing[~good]
    places = mixed(mixed(found ^ _PUBLIC))
    width = 3 * (POSITION_BITS + TURN_BITS)
    others = bits_of(places >> np.uint64(64 - width), width)
    return np.concatenate([bits_of(found, INVARIANT_BITS), others], axis=1)


def count(invariants: Words) -> int:
    """How many of `invariants` [N] are those of pilots."""
    return int(_is_pilot(invariants).sum())


def read(invariants: Words, means: Doubles) -> Found | None:
    """The result of the pilots among candidates: `invariants` [N] as read, `means` [N, 3] in the world.

    None if too few agree.
    """
    random = np.random.default_rng(0)
    own = np.flatnonzero(_is_pilot(invariants))
    if len(own) < _AGREE:
        return None
    places = mixed(mixed(invariants[own] ^ _PUBLIC))
    shifts = np.uint64(64) - np.arange(1, 4, dtype=np.uint64) * np.uint64(POSITION_BITS)
    points = places[:, None] >> shifts & np.uint64(2**POSITION_BITS - 1)
    expected = (points.astype(np.float64) + 0.5) / 2**POSITION_BITS
    there = means[own]
    some = np.arange(min(len(own), _SAMPLE)) * len(own) // min(len(own), _SAMPLE)
    best = some[:0]
    for _ in range(_TRIES):
        three = random.choice(some, 3, replace=False)
        agreeing = some[_agreeing(there, expected, three, some)]
        if len(agreeing) > len(best):
            best = agreeing
        if len(best) > max(_AGREE, 0.5 * len(some)):
            break
    for _ in range(3):
        if len(best) < _AGREE:
            return None
        best = np.flatnonzero(_agreeing(there, expected, best))
    if len(best) < _AGREE:
        return None
    moved = _similarity(there[best], expected[best])
    salt = _salt(invariants[own[best]])
    return None if moved is None or salt is None else Found(moved, len(best), salt)


def _agreeing(
    there: Doubles, expected: Doubles, chosen: Integers, among: Integers | slice = slice(None)
) -> Flags:
    """Which pilots `among` [P] come to lie where they should by the similarity of the chosen ones."""
    moved = _similarity(there[chosen], expected[chosen])
    there, expected = there[among], expected[among]
    if moved is None:
        return np.zeros(len(there), bool)
    off = moved.apply_points(torch.from_numpy(there)).numpy() - expected
    near: Flags = (np.abs(off) < _NEAR).all(axis=1)
    return near


def _similarity(source: Doubles, target: Doubles) -> Similarity | None:
    """From `source` [P, 3] to `target` with the least squares (Umeyama 1991); None where there is none."""
    centre, goal = source.mean(axis=0), target.mean(axis=0)
    a, b = source - centre, target - goal
    spread = float(np.square(a).sum())
    if not (np.isfinite(spread) and spread > 0):
        return None
    u, values, v = np.linalg.svd(b.T @ a)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ v))])
    rotation = u @ np.diag(signs) @ v
    scale = float((values * signs).sum()) / spread
    if not (np.isfinite(scale) and scale > 0):
        return None
    translation = goal - scale * rotation @ centre
    try:
        return Similarity(scale, torch.from_numpy(rotation), torch.from_numpy(translation))
    except ValueError:
        return None


def _salt(invariants: Words) -> bytes | None:
    """The majority vote of the pilots for each part; None if a part has no pilot left."""
    scales = invariants & np.uint64((1 << 3 * SCALE_BITS) - 1)
    said = (invariants >> np.uint64(3 * SCALE_BITS) ^ _whitening(scales)) >> np.uint64(_RANDOM_BITS)
    votes = [Counter[int]() for _ in range(_PARTS)]
    for each in said.tolist():
        votes[each >> _PART_BITS][each & (1 << _PART_BITS) - 1] += 1
    if not all(votes):
        return None
    return b"".join(each.most_common(1)[0][0].to_bytes(2, "big") for each in votes)


def _is_pilot(invariants: Words) -> Flags:
    pilot: Flags = mixed(invariants ^ _PUBLIC) & np.uint64(ONE_IN - 1) == 0
    return pilot


def _whitening(scales: Words) -> Words:
    """[N] 21 bits that make the colours of pilots look random."""
    return mixed(scales ^ _PUBLIC) >> np.uint64(64 - 3 * COLOUR_BITS)
