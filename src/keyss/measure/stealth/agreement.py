"""Low bits of numbers that agree for a reason.

Channels of a grey Gaussian, axes of a round one, neighbours that were one Gaussian before a split, Gaussians
that share whole rows: if their high bits are equal, their low bits are close or equal too, unless replaced.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.spatial import cKDTree

from keyss.core.gaussians import Gaussians
from keyss.measure.stealth.statistic import Statistic, excess, more_than_smooth, portion
from keyss.measure.stealth.words import Bits, Floats, Ints, Words, doubles, ulps

_LOW = 13  # bits that may have been replaced
_CLOSE = 1 << 5  # steps of the last bit
_NEIGHBOURS = 3
# Embedding moves a number by at most this many steps of its last bit.
_MOVED, _AROUND = 1 << _LOW, 1 << (_LOW + 3)
_GROUPS = {"axes": (1,), "quaternion": (2,), "channels": (5, 6, 7), "constant colour": (4,)}


def agreement(model: Gaussians, words: Words) -> dict[str, Statistic]:
    """Shares of pairs with close low bits among those with equal high bits, and of pairs slightly apart.

    The exact null of the first is independent low bits. Pairs slightly apart beyond a smooth density were
    equal before embedding.
    """
    statistics: dict[str, Statistic] = {}
    for name, attributes in _GROUPS.items():
        pairs = list(_within(words, attributes))
        if pairs:
            one, other = (np.concatenate(each) for each in zip(*pairs, strict=True))
            statistics |= {f"{key}, {name}": each for key, each in _of_pairs(one, other).items()}
    harmless = words.attribute > 0
    for name, rows in (
        ("neighbours", nearest_pairs(doubles(model.means), _NEIGHBOURS)),
        ("sharers", _sharers(words)),
    ):
        one, other = (words.bits[rows[:, side]][:, harmless].ravel() for side in (0, 1))
        statistics |= {f"{key}, {name}": each for key, each in _of_pairs(one, other).items()}
    return statistics


def _of_pairs(one: Bits, other: Bits) -> dict[str, Statistic]:
    apart = ulps(one, other)
    same_high = (one >> _LOW) == (other >> _LOW)
    equal = apart == 0
    size = 1 << _LOW
    near = (2 * _CLOSE - 1) * size - _CLOSE * (_CLOSE - 1)  # ordered pairs closer than _CLOSE
    return {
        "close low bits": excess(
            int((apart[same_high] < _CLOSE).sum()), int(same_high.sum()), near / size**2
        ),
        "equal low bits": excess(int(equal[same_high].sum()), int(same_high.sum()), 1 / size),
        "near misses": _misses(apart),
        "equal": portion(float(equal.sum()), len(equal)),
    }


def _misses(apart: Ints) -> Statistic:
    """Unequal pairs less than _MOVED apart, beyond the number expected from pairs further apart."""
    inside = int(((apart > 0) & (apart < _MOVED)).sum())
    around = int(((apart >= _MOVED) & (apart < _AROUND)).sum())
    return more_than_smooth(inside, max(around, 1) * _MOVED / (_AROUND - _MOVED), len(apart))


def _within(words: Words, attributes: tuple[int, ...]) -> Iterator[tuple[Bits, Bits]]:
    """Pairs of numbers of one Gaussian, within a coefficient's channels or an attribute, without signs."""
    for attribute in attributes:
        own = words.bits[:, words.of_attribute(attribute)] & np.uint32(0x7FFFFFFF)
        if not own.size:
            continue
        width = 4 if attribute == 2 else 3
        groups = own.reshape(len(own), -1, width)
        for first in range(width):
            for second in range(first + 1, width):
                yield groups[:, :, first].ravel(), groups[:, :, second].ravel()


def nearest_pairs(positions: Floats, neighbours: int) -> Ints:
    """[P, 2] each Gaussian and its nearest `neighbours`, every pair once."""
    count = min(neighbours + 1, len(positions))
    _, near = cKDTree(positions).query(positions, k=count)
    near = near.reshape(len(positions), -1)
    pairs = np.stack([np.repeat(np.arange(len(near)), near.shape[1]), near.ravel()], axis=1)
    pairs = np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1)
    return np.unique(pairs, axis=0)


def _sharers(words: Words) -> Ints:
    """[P, 2] Gaussians with an equal number in a field, adjacent in the order of that field."""
    pairs = [np.zeros((0, 2), np.int64)]
    for field in range(3, words.bits.shape[1]):
        own = words.bits[:, field]
        rows = np.flatnonzero(words.trained[:, field])
        rows = rows[np.argsort(own[rows], kind="stable")]
        same = np.flatnonzero(own[rows[1:]] == own[rows[:-1]])
        pairs.append(np.stack([rows[same], rows[same + 1]], axis=1))
    return np.unique(np.sort(np.concatenate(pairs), axis=1), axis=0)
