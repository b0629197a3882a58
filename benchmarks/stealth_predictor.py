"""A learned test: boosted trees predict a bit from everything that an attacker sees beside it.

They are trained on plain models of other scenes. They can predict some bits that training left, if the
trainer's arithmetic is visible, but not replaced bits. The null is exact: a fair independent bit agrees with
any prediction half of the time.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from keyss.core import Gaussians
from keyss.core.arrays import Doubles, Flags, Integers, Words32
from keyss.lab.stealth.statistic import NOTHING, BitPatterns, Statistic, normal, ulps

import numpy as np
from scipy.spatial import cKDTree

LOWEST, HIGHEST = 1, 13  # predicted bits, those that embedding may replace
UNCHANGED_ATTRIBUTES = (0, 4)  # positions and constant colours
_ABOVE, _BELOW = 5, 4  # neighbouring bits among the features
ROWS = 30_000  # rows per model
_TREES, _LEAVES = 60, 24
_UNSIGNED = np.uint32(0x7FFFFFFF)
_SURE = 0.1  # minimum distance from 1/2 of a confident prediction
_MIN_COUNT = 64
_OFTEN = 6  # occurrences: three channels of a grey Gaussian and of its sibling
_DISTANCES = slice(0, 2)  # columns of the features


def fit_predictor(samples: Sequence[tuple[Doubles, Integers]]) -> Any:
    """Trees that predict single bits, from results of `sample` on scenes other than the judged ones."""
    from sklearn.ensemble import HistGradientBoostingClassifier  # slow to import

    x, y = (np.concatenate(each) for each in zip(*samples, strict=True))
    trees = HistGradientBoostingClassifier(
        max_iter=_TREES, max_leaf_nodes=_LEAVES, l2_regularization=1.0, min_samples_leaf=50, random_state=0
    )
    return trees.fit(x, y)


def predictor_statistics(trees: Any, model: Gaussians) -> dict[str, float]:
    """Prediction quality on the bits of a file.

    Gain in log-likelihood per bit, and agreement with predictions / expected agreement, which is 1 for plain
    models and 0 for random bits; null: 0.
    """
    seen, bits = sample(model, ROWS)
    chance = trees.predict_proba(seen)[:, 1]
    said = np.where(bits == 1, chance, 1 - chance).clip(1e-6)
    found = {"gain": Statistic(float(np.log2(2 * said).mean()))}
    nearest = seen[:, _DISTANCES].min(axis=1)
    kinds = {
        "without a like": nearest >= HIGHEST,
        "beside a like": (nearest > 0) & (nearest < HIGHEST),
        "beside its equal": nearest == 0,
    }
    for kind, own in kinds.items():
        for name, least in (("", 0.0), (", sure", _SURE)):
            rows = own & (np.abs(chance - 0.5) > least)
            found[f"agreement {kind}{name}"] = _agreement(chance[rows] - 0.5, bits[rows] - 0.5)
    return {f"predictor: {name}": each.value for name, each in found.items() if not np.isnan(each.value)}


def _agreement(lean: Doubles, came: Doubles) -> Statistic:
    promised = float((2 * lean**2).sum())
    if len(lean) < _MIN_COUNT or promised == 0:
        return NOTHING
    return normal(float((lean * came * 2).sum()) / promised, float((lean**2).sum()) ** 0.5 / promised)


def sample(model: Gaussians, rows: int) -> tuple[Doubles, Integers]:
    """[R, features] and [R] bits of the smallest numbers, of those with the nearest relatives, and of any."""
    words = BitPatterns.of(model)
    random = np.random.default_rng(0)
    beside, distance = _likes(words, model)
    # Frequent numbers are multiples of a learning rate, which embedding does not change.
    allowed = words.trained & ~np.isin(words.attribute, UNCHANGED_ATTRIBUTES) & ~_is_frequent(words.bits)
    chosen = []
    candidates = np.flatnonzero(allowed)
    if not len(candidates):
        return np.zeros((0, 1)), np.zeros(0, np.int64)
    for badness in (words.exponent, distance.min(axis=0)):
        flat = badness.ravel()[candidates] + random.random(len(candidates))
        count = min(rows // 3, len(candidates))
        chosen.append(candidates[np.argpartition(flat, count - 1)[:count]])
    chosen.append(random.choice(candidates, rows // 3))
    at = np.concatenate(chosen)
    bit = random.integers(LOWEST, HIGHEST, len(at))
    return _features(words, at, bit, beside, distance), (words.bits.ravel()[at] >> bit & 1).astype(np.int64)


def _features(words: BitPatterns, at: Integers, bit: Integers, beside: Words32, distance: Doubles) -> Doubles:
    """[R, features] of the bits of numbers `at` flat indices."""
    own, width = words.bits.ravel()[at], words.bits.shape[1]
    row, field = at // width, at % width
    columns: list[Any] = [each.ravel()[at] for each in distance]
    columns += [beside[index].ravel()[at] >> bit & 1 for index in range(len(beside))]
    columns += [words.attribute[field], words.exponent.ravel()[at], bit]
    for step in range(1, _BELOW + 1):
        columns.append(np.where(bit >= step, own >> np.maximum(bit - step, 0) & 1, 2))
    columns += [own >> (bit + step) & 1 for step in range(1, _ABOVE + 1)]
    below = own & ((np.uint32(1) << bit.astype(np.uint32)) - np.uint32(1))
    columns += [own & 1, below == 0]
    harmonics = words.attribute > 4
    if harmonics.any():
        columns.append(np.where(words.trained, words.exponent, 0)[:, harmonics].min(axis=1)[row])
        zeros = (words.bits[:, harmonics] & 1 == 0) & words.trained[:, harmonics]
        columns += [zeros.mean(axis=1)[row]]
    return np.stack([np.asarray(each, np.float64) for each in columns], axis=1)


def _is_frequent(bits: Words32) -> Flags:
    """[N, F] True for numbers whose magnitude occurs often."""
    _, inverse, times = np.unique(bits & _UNSIGNED, return_inverse=True, return_counts=True)
    found: Flags = (times > _OFTEN)[inverse].reshape(bits.shape)
    return found


def _likes(words: BitPatterns, model: Gaussians) -> tuple[Words32, Doubles]:
    """[L, N, F] related numbers, and [L, N, F] base-2 logarithms of their distance in the last place.

    The nearest of the other channels or axes of the same Gaussian, and the same field of the nearest
    neighbour in space.
    """
    bits = words.bits
    nearest = np.zeros_like(bits)
    least = np.full(bits.shape, np.int64(1) << 31)
    for attribute, width in ((1, 3), (2, 4), (4, 3), (5, 3), (6, 3), (7, 3)):
        own = words.of_attribute(attribute)
        if own.stop == own.start:
            continue
        groups = bits[:, own].reshape(len(bits), -1, width)
        for turn in range(1, width):
            other = np.roll(groups, turn, axis=2).reshape(len(bits), -1)
            apart = ulps(bits[:, own] & _UNSIGNED, other & _UNSIGNED)
            closer = apart < least[:, own]
            nearest[:, own] = np.where(closer, other, nearest[:, own])
            least[:, own] = np.where(closer, apart, least[:, own])
    positions = model.means.detach().cpu().double().numpy()
    neighbour = (
        cKDTree(positions).query(positions, k=min(2, len(positions)))[1].reshape(len(positions), -1)[:, -1]
    )
    beside = np.stack([nearest, bits[neighbour]])
    return beside, np.log2(1.0 + np.stack([least, ulps(bits, bits[neighbour])]))
