"""Low bits of related numbers.

Channels of a grey Gaussian, axes of a round one, halves of a split, Gaussians that share rows: if their high
bits are equal, their low bits are close or equal too, unless embedding has replaced them.

Coincidences are numbers of two Gaussians with equal high bits and bit 0, which embedding keeps. Training
copies or freezes numbers in clones: saturated opacities, harmonics of one channel, whole Gaussians. Embedding
makes their other bits random, unless neither Gaussian is a carrier. The null for pairs with a usable Gaussian
is exact: independent low bits.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import numpy as np

from keyss.channels import usable_carriers
from keyss.core.arrays import Doubles, Flags, Integers, Words32, doubles
from keyss.core.gaussians import Gaussians
from keyss.core.neighbours import nearest_neighbours
from keyss.lab.stealth.statistic import (
    ATTRIBUTES,
    NOTHING,
    BitPatterns,
    Statistic,
    excess,
    excess_over_smooth,
    normal,
    portion,
    ulps,
)

_LOW = 13  # bits that may have been replaced
_QUARTER, _MANY = 21, 1000  # lowest differing bit of quarters of octaves; minimum pairs of numbers
_CLOSE = 1 << 5  # units in the last place
_NEIGHBOURS = 3
# Maximum change by embedding, and the range that gives the smooth density; units in the last place.
_MOVED, _AROUND = 1 << _LOW, 1 << (_LOW + 3)
_GROUPS = {"axes": (1,), "quaternion": (2,), "channels": (5, 6, 7), "constant colour": (4,)}
_WRITTEN = {"scale": 8, "rotation": 8, "opacity": 8, "sh1": 12, "sh2": 12, "sh3": 12}  # bits above bit 0
_CHANNELS = ("red", "green", "blue")
_LAGS = 4  # maximum distance of pairs in the order of their high bits
_NEAREST = 16
_SATURATED = 16.0  # logit


def agreement(model: Gaussians, words: BitPatterns) -> dict[str, Statistic]:
    """Shares of pairs with close low bits among those with equal high bits, and of near misses.

    The exact null of the first is independent low bits. Near misses in excess of a smooth density were equal
    before embedding.
    """
    statistics: dict[str, Statistic] = {}
    for name, attributes in _GROUPS.items():
        pairs = list(_pairs_within_gaussians(words, attributes))
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


def _of_pairs(one: Words32, other: Words32) -> dict[str, Statistic]:
    distance = ulps(one, other)
    same_high = (one >> _LOW) == (other >> _LOW)
    equal = distance == 0
    size = 1 << _LOW
    inside = int(((distance > 0) & (distance < _MOVED)).sum())
    around = int(((distance >= _MOVED) & (distance < _AROUND)).sum())
    near = (2 * _CLOSE - 1) * size - _CLOSE * (_CLOSE - 1)  # ordered pairs closer than _CLOSE
    return {
        "close low bits": excess(
            int((distance[same_high] < _CLOSE).sum()), int(same_high.sum()), near / size**2
        ),
        "equal low bits": excess(int(equal[same_high].sum()), int(same_high.sum()), 1 / size),
        # Unequal pairs closer than _MOVED, against the number expected from pairs further apart.
        "near misses": excess_over_smooth(inside, max(around, 1) * _MOVED / (_AROUND - _MOVED), len(equal)),
        "equal": portion(float(equal.sum()), len(equal)),
        "within a quarter of an octave": _within_quarters(one, other),
    }


def _within_quarters(one: Words32, other: Words32) -> Statistic:
    """Correlation of the next 8 bits if exponents and the two leading bits agree; 0 for random bits."""
    both = (one >> _QUARTER == other >> _QUARTER) & (one > 0) & (other > 0)
    if both.sum() < _MANY:
        return NOTHING
    covariance = np.cov(*((words[both] >> _LOW & 255).astype(np.float64) for words in (one, other)))
    return normal(12 * float(covariance[0, 1]) / (1 << 16), float(both.sum()) ** -0.5)


def _pairs_within_gaussians(
    words: BitPatterns, attributes: tuple[int, ...]
) -> Iterator[tuple[Words32, Words32]]:
    """Pairs of magnitudes in one Gaussian, within a coefficient's channels or an attribute."""
    for attribute in attributes:
        own = words.bits[:, words.of_attribute(attribute)] & np.uint32(0x7FFFFFFF)
        if not own.size:
            continue
        width = 4 if attribute == 2 else 3
        groups = own.reshape(len(own), -1, width)
        for first, second in combinations(range(width), 2):
            yield groups[:, :, first].ravel(), groups[:, :, second].ravel()


def nearest_pairs(positions: Doubles, neighbours: int) -> Integers:
    """[P, 2] pairs of each Gaussian and its nearest `neighbours`, each pair once."""
    count = min(neighbours + 1, len(positions))
    _, near = nearest_neighbours(positions, count)
    pairs = np.stack([np.repeat(np.arange(len(near)), near.shape[1]), near.ravel()], axis=1)
    pairs = np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1)
    return np.unique(pairs, axis=0)


def _sharers(words: BitPatterns) -> Integers:
    """[P, 2] Gaussians with an equal number in a field, adjacent in the order of that field."""
    pairs = [np.zeros((0, 2), np.int64)]
    for field in range(3, words.bits.shape[1]):
        own = words.bits[:, field]
        rows = np.flatnonzero(words.trained[:, field])
        rows = rows[np.argsort(own[rows], kind="stable")]
        same = np.flatnonzero(own[rows[1:]] == own[rows[:-1]])
        pairs.append(np.stack([rows[same], rows[same + 1]], axis=1))
    return np.unique(np.sort(np.concatenate(pairs), axis=1), axis=0)


def coincidences(model: Gaussians, words: BitPatterns) -> dict[str, Statistic]:
    """Pairs with equal low bits among those with equal high bits, relative to chance."""
    return {
        name: excess(equal, pairs, 2.0**-bits)
        for name, (equal, pairs, bits) in count_coincidences(model, words).items()
    }


def count_coincidences(model: Gaussians, words: BitPatterns) -> dict[str, tuple[int, int, int]]:
    """Numbers by name: pairs with equal low bits, pairs with equal high bits, low bits.

    For all pairs and for neighbours in space, if one Gaussian is usable; for all saturated neighbours.
    """
    usable = usable_carriers(model)
    near = nearest_pairs(doubles(model.means), _NEAREST)
    saturated = model.opacity_logits.detach().cpu().numpy() > _SATURATED
    bright = near[saturated[near].all(axis=1)]
    counts: dict[str, tuple[int, int, int]] = {}
    for name, field, bits in _columns(words):
        low = np.uint32(((1 << bits) - 1) << 1)
        own = words.bits[:, field]
        of_all, of_near, of_bright = f"all, {name}", f"neighbours, {name}", f"saturated, {name}"
        for kind, pairs, chosen in (
            (of_all, _agreeing_pairs(own & ~low), usable),
            (of_near, near, usable),
            (of_bright, bright, np.ones(len(usable), bool)),
        ):
            one, other = pairs[chosen[pairs].any(axis=1)].T
            agree = (own[one] & ~low) == (own[other] & ~low)
            equal, trials, _ = counts.get(kind, (0, 0, bits))
            equal += int((own[one] == own[other])[agree].sum())
            counts[kind] = equal, trials + int(agree.sum()), bits
    return counts


def _columns(words: BitPatterns) -> Iterator[tuple[str, int, int]]:
    """Name, index and replaced bits of each column; the harmonics of a channel share a name."""
    for index, attribute in enumerate(ATTRIBUTES):
        if attribute in _WRITTEN:
            for number, column in enumerate(np.flatnonzero(words.attribute == index)):
                name = _CHANNELS[number % 3] if attribute.startswith("sh") else attribute
                yield name, int(column), _WRITTEN[attribute]


def _agreeing_pairs(kept: np.ndarray) -> Integers:
    """[P, 2] pairs of rows whose `kept` bits [N] agree, at most _LAGS apart when sorted by these."""
    order = np.argsort(kept, kind="stable")
    pairs = [np.zeros((0, 2), np.int64)]
    for lag in range(1, min(_LAGS, len(kept) - 1) + 1):
        same: Flags = kept[order[lag:]] == kept[order[:-lag]]
        pairs.append(np.stack([order[:-lag][same], order[lag:][same]], axis=1))
    return np.concatenate(pairs)
