"""Detectors of low bits that are not what training left, conditioned on all else that an attacker sees.

- `bits`: mantissa bits that are not random, by attribute, magnitude and position of the bit, and given the
  bit below. Numbers with a zero in the last bit have zeros above it too after training, but not after
  embedding.
- `agreement`: channels of a grey Gaussian, axes of a round one, halves of a split, Gaussians that share rows:
  if their high bits are equal, their low bits are close or equal too, unless embedding has replaced them.
- `coincidences`: numbers of two Gaussians with equal high bits and bit 0, which embedding keeps. Training
  copies or freezes numbers in clones: saturated opacities, harmonics of one channel, whole Gaussians.
  Embedding makes their other bits random, unless neither Gaussian is a carrier. The null for pairs with a
  usable Gaussian is exact: independent low bits.
- `steps`: siblings that moved apart by equal steps of Adam, so that constant colours predict low bits of
  harmonics (`keyss.channels.quiet.predictability`). Pairs are found by high bits and constant colours. A hit
  is a difference of harmonics within 1/16 of a cell (the range of low bits) of a twentieth of that of the
  constant colours. The null distribution comes from the same file with other low bits.
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
    MAGNITUDES,
    MANTISSA,
    NOTHING,
    BitPatterns,
    Statistic,
    dispersion,
    excess,
    near_misses,
    normal,
    portion,
    share,
    ulps,
)

RANGES = {"0": (0, 1), "1-3": (1, 4), "4-8": (4, 9), "9-12": (9, 13)}
_BITS = 14  # lowest bits of a number
_HARMONICS = ATTRIBUTES.index("sh1")
_MIN_COUNT = 64  # numbers of a stratum

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

_LOW_MASK = np.uint32((1 << 13) - 1)
_RATIO = 20.0  # learning rate of constant colours / harmonics
_AGREE = 4  # minimum agreeing harmonics of a colour
_PART = 16  # a hit is within cell / 16 of the prediction
_DRAWS, _MAX_DIFFERENCES, _MIN_EXPECTED = 200, 16_000, 5.0


def bits(model: Gaussians, words: BitPatterns) -> dict[str, Statistic]:
    """Statistics of single numbers by attribute and magnitude, with an exact null: fair, independent bits."""
    statistics: dict[str, Statistic] = {}
    for index, attribute in enumerate(ATTRIBUTES):
        columns = words.of_attribute(index)
        own = words.bits[:, columns][words.trained[:, columns]]
        if len(own):
            statistics |= {f"{name}, {attribute}": each for name, each in _of_values(own).items()}
            statistics[f"strata of {attribute}"] = _strata(own)
    harmonics = words.attribute >= _HARMONICS
    own, trained = words.bits[:, harmonics], words.trained[:, harmonics]
    exponent = words.exponent[:, harmonics]
    for magnitude, (low, high) in MAGNITUDES.items():
        values = own[trained & (exponent >= low) & (exponent < high)]
        statistics |= {f"{name}, {magnitude} harmonics": each for name, each in _of_values(values).items()}
    small = trained & (exponent < MAGNITUDES["middling"][1])
    statistics["zeros together in a Gaussian"] = _count_variance(own, small)
    tiny = (trained & (exponent < MAGNITUDES["tiny"][1])).any(axis=1)
    for name, rows in (("with", tiny), ("without", ~tiny)):
        found = _of_values(own[rows][trained[rows]])["ones in bits 1-3"]
        statistics[f"Gaussians with tiny harmonics, ones in bits 1-3 {name}"] = found
    return statistics


def _of_values(values: Words32) -> dict[str, Statistic]:
    """Shares of ones, of trailing zeros, and of zeros in bits 1 to 3 given bit 0."""
    statistics = {}
    for name, (low, high) in RANGES.items():
        ones = sum(int((values >> bit & 1).sum()) for bit in range(low, high))
        statistics[f"ones in bits {name}"] = share(ones, len(values) * (high - low))
    for count in (4, 8):
        zeros = int((values & np.uint32((1 << count) - 1) == 0).sum())
        statistics[f"{count} zeros at the end"] = share(
            zeros, len(values) if len(values) >> count > 5 else 0, 2.0**-count
        )
    even = values & 1 == 0
    clear = values & np.uint32(14) == 0
    statistics["zeros above a zero"] = _difference(clear[even], clear[~even], 1 / 8)
    return statistics


def _difference(one: Flags, other: Flags, expected: float) -> Statistic:
    """Difference of the shares in `one` and `other`, both `expected` under the null."""
    if min(len(one), len(other)) < _MIN_COUNT:
        return NOTHING
    error = (expected * (1 - expected) * (1 / len(one) + 1 / len(other))) ** 0.5
    return normal(float(one.mean() - other.mean()), error)


def _strata(values: Words32) -> Statistic:
    """Chi-square of the ones by exponent, position of the bit and the bit below."""
    total, degrees = 0.0, 0
    exponent = (values >> MANTISSA & 255).astype(np.int64)
    for bit in range(1, _BITS):
        stratum = exponent * 2 + (values >> (bit - 1) & 1)
        count = np.bincount(stratum)
        ones = np.bincount(stratum, weights=values >> bit & 1)
        enough = count >= _MIN_COUNT
        total += float(((ones - count / 2) ** 2 / np.maximum(count / 4, 1))[enough].sum())
        degrees += int(enough.sum())
    return dispersion(total, degrees)


def _count_variance(values: Words32, chosen: Flags) -> Statistic:
    """Variance over Gaussians of their count of small harmonics with zeros in bits 1 to 3."""
    zeros = ((values & np.uint32(14) == 0) & chosen).sum(axis=1)
    trials = chosen.sum(axis=1)
    rows = trials > 1
    if rows.sum() < _MIN_COUNT:
        return NOTHING
    z2 = (zeros[rows] - trials[rows] / 8) ** 2 / (trials[rows] * 7 / 64)
    # The kurtosis of a binomial number: 1 / variance - 6 / n beyond that of a normal one.
    variance = 2 + 1 / (trials[rows] * 7 / 64) - 6 / trials[rows]
    error = float(np.sqrt(variance.sum()) / rows.sum())
    return normal(float(z2.mean() - 1), error)


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
    near = (2 * _CLOSE - 1) * size - _CLOSE * (_CLOSE - 1)  # ordered pairs closer than _CLOSE
    return {
        "close low bits": excess(
            int((distance[same_high] < _CLOSE).sum()), int(same_high.sum()), near / size**2
        ),
        "equal low bits": excess(int(equal[same_high].sum()), int(same_high.sum()), 1 / size),
        "near misses": near_misses(distance, equal, _MOVED, _AROUND),
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
    pairs = []
    for field in range(3, words.bits.shape[1]):
        rows = np.flatnonzero(words.trained[:, field])
        pairs.append(rows[_agreeing_pairs(words.bits[rows, field], lags=1)])
    return np.unique(np.sort(np.concatenate(pairs), axis=1), axis=0)


def coincidences(model: Gaussians, words: BitPatterns) -> dict[str, Statistic]:
    """Pairs with equal low bits among those with equal high bits, relative to chance.

    For all pairs and for neighbours in space, if one Gaussian is usable; for all saturated neighbours.
    """
    usable = usable_carriers(model)
    near = nearest_pairs(doubles(model.means), _NEAREST)
    saturated = model.opacity_logits.detach().cpu().numpy() > _SATURATED
    bright = near[saturated[near].all(axis=1)]
    # By name: pairs with equal low bits, pairs with equal high bits, and the number of low bits.
    counts: dict[str, tuple[int, int, int]] = {}
    for name, field, bits in _columns(words):
        low = np.uint32(((1 << bits) - 1) << 1)
        own = words.bits[:, field]
        of_all, of_near, of_bright = f"all, {name}", f"neighbours, {name}", f"saturated, {name}"
        for kind, pairs, chosen in (
            (of_all, _agreeing_pairs(own & ~low, _LAGS), usable),
            (of_near, near, usable),
            (of_bright, bright, np.ones(len(usable), bool)),
        ):
            one, other = pairs[chosen[pairs].any(axis=1)].T
            agree = (own[one] & ~low) == (own[other] & ~low)
            equal, trials, _ = counts.get(kind, (0, 0, bits))
            equal += int((own[one] == own[other])[agree].sum())
            counts[kind] = equal, trials + int(agree.sum()), bits
    return {name: excess(equal, trials, 2.0**-bits) for name, (equal, trials, bits) in counts.items()}


def _columns(words: BitPatterns) -> Iterator[tuple[str, int, int]]:
    """Name, index and replaced bits of each column; the harmonics of a channel share a name."""
    for index, attribute in enumerate(ATTRIBUTES):
        if attribute in _WRITTEN:
            for number, column in enumerate(np.flatnonzero(words.attribute == index)):
                name = _CHANNELS[number % 3] if attribute.startswith("sh") else attribute
                yield name, int(column), _WRITTEN[attribute]


def _agreeing_pairs(kept: Words32, lags: int) -> Integers:
    """[P, 2] pairs of rows whose `kept` bits [N] agree, at most `lags` apart when sorted by these."""
    order = np.argsort(kept, kind="stable")
    pairs = [np.zeros((0, 2), np.int64)]
    for lag in range(1, min(lags, len(kept) - 1) + 1):
        same: Flags = kept[order[lag:]] == kept[order[:-lag]]
        pairs.append(np.stack([order[:-lag][same], order[lag:][same]], axis=1))
    return np.concatenate(pairs)


def steps(model: Gaussians, words: BitPatterns) -> dict[str, Statistic]:
    """Excess of hits over random low bits, in standard deviations."""
    harmonics = words.bits[:, words.attribute >= _HARMONICS]
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
    return words & ~(_LOW_MASK - np.uint32(1)) | new


def _numbers(words: Words32) -> Doubles:
    return words.view(np.float32).astype(np.float64)


def _middle(words: Words32) -> Doubles:
    return _numbers(words & ~_LOW_MASK | (_LOW_MASK + 1) >> 1)


def _cells(words: Words32) -> Doubles:
    """The range of each number's low bits."""
    return 2 * np.abs(_middle(words) - _numbers(words & ~_LOW_MASK))
