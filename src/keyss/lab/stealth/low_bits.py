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
- `steps`: siblings that moved apart by equal steps of Adam, so that numbers predict each other's low bits
  (`keyss.channels.lsb.equal_steps`). A hit is a difference between neighbours, or between two colours, that
  agrees to 1/8 of a cell (the range of low bits) with that of another number of its group, or with that of
  the constant colour divided by the ratio of their rates. Neighbours are near in space or agree in sums and
  differences of three harmonics. Candidates are found by the bits that stay. The null distribution comes
  from the same file with other low bits in usable Gaussians.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import numpy as np

from keyss.channels import DEEPEST, usable_carriers
from keyss.channels.lsb.equal_steps import redrawn
from keyss.core.arrays import Doubles, Flags, Integers, Words32, doubles
from keyss.core.errors import UsageError
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

RANGES = {"0": (0, 1), "1-3": (1, 4), "4-8": (4, 9)}
_BITS = DEEPEST + 2  # lowest bits of a number
_HARMONICS = ATTRIBUTES.index("sh1")
_MIN_COUNT = 64  # numbers of a stratum

_LOW = DEEPEST + 1  # bits that may have been replaced
_QUARTER, _MANY = 21, 1000  # lowest differing bit of quarters of octaves; minimum pairs of numbers
_CLOSE = 1 << 5  # units in the last place
_NEIGHBOURS = 3
# Maximum change by embedding, and the range that gives the smooth density; units in the last place.
_MOVED, _AROUND = 1 << _LOW, 1 << (_LOW + 3)
_GROUPS = {"axes": (1,), "quaternion": (2,), "channels": (5, 6, 7), "constant colour": (4,)}
_WRITTEN = dict.fromkeys(("scale", "rotation", "opacity", "sh1", "sh2", "sh3"), DEEPEST)  # bits above bit 0
_CHANNELS = ("red", "green", "blue")
_LAGS = 4  # maximum distance of pairs in the order of their high bits
_NEAREST = 16
_SATURATED = 16.0  # logit

_MAGNITUDE = np.uint32(0x7FFFFFFF)
_LOW_MASK = np.uint32((1 << DEEPEST + 1) - 1)
_STEP_NEIGHBOURS = 12
_RATIOS = (20, 10, 5, 1)  # learning rate of constant colours / harmonics, in common trainers
_AGREE = (1, 3)  # minimum agreeing harmonics of a colour
_PART = 8  # a hit is within cell / 8 of the prediction
_PAIRS = 1 << 16  # at a time
_DRAWS, _MAX_DIFFERENCES, _MIN_EXPECTED = 24, 200_000, 5.0


def bits(model: Gaussians, words: BitPatterns) -> dict[str, Statistic]:
    """Statistics of single numbers by attribute and magnitude, with an exact null: fair, independent bits."""
    statistics: dict[str, Statistic] = {}
    for index, attribute in enumerate(ATTRIBUTES):
        columns = words.of_attribute(index)
        bits = words.bits[:, columns][words.trained[:, columns]]
        if len(bits):
            statistics |= {f"{name}, {attribute}": statistic for name, statistic in _of_values(bits).items()}
            statistics[f"strata of {attribute}"] = _strata(bits)
    harmonics = words.attribute >= _HARMONICS
    bits, trained = words.bits[:, harmonics], words.trained[:, harmonics]
    exponent = words.exponent[:, harmonics]
    for magnitude, (low, high) in MAGNITUDES.items():
        values = bits[trained & (exponent >= low) & (exponent < high)]
        statistics |= {
            f"{name}, {magnitude} harmonics": statistic for name, statistic in _of_values(values).items()
        }
    small = trained & (exponent < MAGNITUDES["middling"][1])
    statistics["zeros together in a Gaussian"] = _count_variance(bits, small)
    tiny = (trained & (exponent < MAGNITUDES["tiny"][1])).any(axis=1)
    for name, rows in (("with", tiny), ("without", ~tiny)):
        ones = _of_values(bits[rows][trained[rows]])["ones in bits 1-3"]
        statistics[f"Gaussians with tiny harmonics, ones in bits 1-3 {name}"] = ones
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
            one, other = (np.concatenate(side, axis=1) for side in zip(*pairs, strict=True))
            of_pairs = _of_pairs(one, other, np.arange(len(one)))
            statistics |= {f"{key}, {name}": statistic for key, statistic in of_pairs.items()}
    harmless = words.attribute > 0
    for name, rows in (
        ("neighbours", nearest_pairs(doubles(model.means), _NEIGHBOURS)),
        ("sharers", _sharers(words)),
    ):
        one, other = (words.bits[rows[:, side]][:, harmless] for side in (0, 1))
        of_pairs = _of_pairs(one, other, rows[:, 0])
        statistics |= {f"{key}, {name}": statistic for key, statistic in of_pairs.items()}
    return statistics


def _of_pairs(one: Words32, other: Words32, gaussians: Integers) -> dict[str, Statistic]:
    """Statistics of pairs of numbers [P, C]; `gaussians` [P]: index of a Gaussian of each row."""
    alike = np.bincount(gaussians, (one == other).sum(axis=1))
    trials = np.bincount(gaussians) * one.shape[1]
    gaussians = np.repeat(gaussians, one.shape[1])
    one, other = one.ravel(), other.ravel()
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
        "equal": portion(alike, trials),
        "within a quarter of an octave": _within_quarters(one, other, gaussians),
    }


def _within_quarters(one: Words32, other: Words32, gaussians: Integers) -> Statistic:
    """Correlation of the next 8 bits if exponents and the two leading bits agree; 0 for random bits.

    Pairs of one of the `gaussians` [P] depend on each other, so its error comes from sums over them.
    """
    both = (one >> _QUARTER == other >> _QUARTER) & (one > 0) & (other > 0)
    if both.sum() < _MANY:
        return NOTHING
    a, b = ((words[both] >> _LOW & 255) / 256.0 for words in (one, other))
    products = 12 * (a - a.mean()) * (b - b.mean())
    error = float(np.square(np.bincount(gaussians[both], products)).sum()) ** 0.5 / len(products)
    return normal(float(products.mean()), max(error, len(products) ** -0.5))


def _pairs_within_gaussians(
    words: BitPatterns, attributes: tuple[int, ...]
) -> Iterator[tuple[Words32, Words32]]:
    """Pairs [N, C] of magnitudes in one Gaussian, within a coefficient's channels or an attribute."""
    for attribute in attributes:
        magnitudes = words.bits[:, words.of_attribute(attribute)] & np.uint32(0x7FFFFFFF)
        if not magnitudes.size:
            continue
        width = 4 if attribute == 2 else 3
        groups = magnitudes.reshape(len(magnitudes), -1, width)
        for first, second in combinations(range(width), 2):
            yield groups[:, :, first], groups[:, :, second]


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
    usable = _usable(model)
    near = nearest_pairs(doubles(model.means), _NEAREST)
    saturated = model.opacity_logits.detach().cpu().numpy() > _SATURATED
    bright = near[saturated[near].all(axis=1)]
    # By name: pairs with equal low bits, pairs with equal high bits, and the number of low bits.
    counts: dict[str, tuple[int, int, int]] = {}
    for name, field, bits in _columns(words):
        low = np.uint32(((1 << bits) - 1) << 1)
        numbers = words.bits[:, field]
        of_all, of_near, of_bright = f"all, {name}", f"neighbours, {name}", f"saturated, {name}"
        for kind, pairs, chosen in (
            (of_all, _agreeing_pairs(numbers & ~low, _LAGS), usable),
            (of_near, near, usable),
            (of_bright, bright, np.ones(len(usable), bool)),
        ):
            one, other = pairs[chosen[pairs].any(axis=1)].T
            agree = (numbers[one] & ~low) == (numbers[other] & ~low)
            equal, trials, _ = counts.get(kind, (0, 0, bits))
            equal += int((numbers[one] == numbers[other])[agree].sum())
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


def _usable(model: Gaussians) -> Flags:
    try:
        return usable_carriers(model)
    except UsageError:  # new bits would show: the question is where
        return np.ones(len(model), bool)


def steps(model: Gaussians, words: BitPatterns) -> dict[str, Statistic]:
    """Hits beyond those after new draws of the low bits of usable Gaussians, in standard deviations."""
    pairs = nearest_pairs(np.nan_to_num(doubles(model.means)), _STEP_NEIGHBOURS)
    usable = _usable(model)
    attribute, statistics = words.attribute, {}
    groups = {"scales": words.bits[:, attribute == 1], "quaternions": words.bits[:, attribute == 2]}
    harmonics = words.bits[:, attribute >= _HARMONICS]
    colours = {f"harmonics, {name}": harmonics[:, index::3] for index, name in enumerate(_CHANNELS)}
    for numbers in colours.values() if model.sh_degree else ():
        one, *others = _middle(numbers[:, :3]).T
        for signs in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
            kept = np.stack([one - sign * other for sign, other in zip(signs, others, strict=True)], axis=1)
            pairs = np.concatenate([pairs, nearest_pairs(np.nan_to_num(kept), 1)])
    pairs = np.unique(pairs[usable[pairs].any(axis=1)], axis=0)
    constants = doubles(model.sh[:, 0])
    drawn = np.random.default_rng(0)
    for name, numbers in {**groups, **colours}.items():
        if numbers.shape[1]:
            statistics[f"equal steps of two {name}"] = _excess(
                numbers, usable, drawn, *_two_equal(numbers, pairs)
            )
    if model.sh_degree:
        rows = np.flatnonzero(usable.repeat(3))
        both = np.stack([rows, rows - rows % 3 + (rows + 1) % 3], axis=1)
        numbers = np.stack(list(colours.values()), axis=1).reshape(3 * len(model), -1) & _MAGNITUDE
        equal = _excess(numbers, usable.repeat(3), drawn, *_two_equal(numbers, both))
        statistics["equal steps of two harmonics, two colours"] = equal
    for ratio in _RATIOS if model.sh_degree else ():
        for least in _AGREE:
            for index, numbers in enumerate(colours.values()):
                moved = np.abs(constants[pairs[:, 0], index] - constants[pairs[:, 1], index]) / ratio
                name = f"{least} or more follow the constant colour, ratio {ratio}, {_CHANNELS[index]}"
                statistics[name] = _excess(numbers, usable, drawn, *_follow(numbers, pairs, moved, least))
    return statistics


# Pairs, columns, steps or 0, other columns, cells.
_Candidates = tuple[Integers, Integers, Doubles, Integers, Doubles]


def _two_equal(own: Words32, pairs: Integers) -> _Candidates:
    """Pairs of columns of `own` [N, C] whose differences agree, as far as the bits that stay tell."""
    middle, cells, candidates = _middle(own), _cells(own), []
    for start in range(0, len(pairs), _PAIRS):
        one, other = pairs[start : start + _PAIRS].T
        moved, cell = np.abs(middle[one] - middle[other]), np.maximum(cells[one], cells[other])
        for a, b in combinations(range(own.shape[1]), 2):
            span = np.maximum(cell[:, a], cell[:, b])
            rows = np.flatnonzero((np.abs(moved[:, a] - moved[:, b]) <= span) & (moved[:, a] > 2 * span))
            columns = np.full(len(rows), a), np.full(len(rows), b)
            candidates.append((pairs[start + rows], columns[0], np.zeros(len(rows)), columns[1], span[rows]))
    return _joined(candidates)


def _follow(own: Words32, pairs: Integers, moved: Doubles, least: int) -> _Candidates:
    """Columns of `own` [N, C] whose differences agree with `moved` [P], where `least` or more do."""
    middle, cells, candidates = _middle(own), _cells(own), []
    for start in range(0, len(pairs), _PAIRS):
        (one, other), steps = pairs[start : start + _PAIRS].T, moved[start : start + _PAIRS, None]
        cell = np.maximum(cells[one], cells[other])
        near = (np.abs(np.abs(middle[one] - middle[other]) - steps) <= 1.5 * cell) & (steps > 2 * cell)
        rows, columns = np.nonzero(near & (near.sum(axis=1) >= least)[:, None])
        candidates.append((pairs[start + rows], columns, steps[rows, 0], columns, cell[rows, columns]))
    return _joined(candidates)


def _joined(candidates: list[_Candidates]) -> _Candidates:
    index, number = np.zeros(0, np.int64), np.zeros(0)
    every = [(np.zeros((0, 2), np.int64), index, number, index, number), *candidates]
    return tuple(np.concatenate(columns)[:_MAX_DIFFERENCES] for columns in zip(*every, strict=True))  # type: ignore[return-value]


def _excess(
    own: Words32,
    usable: Flags,
    random: np.random.Generator,
    pairs: Integers,
    columns: Integers,
    moved: Doubles,
    others: Integers,
    cells: Doubles,
) -> Statistic:
    """Differences in `columns` [P] that agree with those in `others` or, where it is not 0, with `moved`."""

    def hits(words: Words32) -> int:
        values = words.view(np.float32).astype(np.float64)
        one, other = (np.abs(values[pairs[:, 0], at] - values[pairs[:, 1], at]) for at in (columns, others))
        return int((np.abs(one - np.where(moved > 0, moved, other)) < cells / _PART).sum())

    drawn = [hits(redrawn(own, usable, DEEPEST, random)) for _ in range(_DRAWS)]
    expected = float(np.mean(drawn))
    if expected < _MIN_EXPECTED:
        return NOTHING
    error = max(1.0, expected**0.5, float(np.std(drawn)))
    return normal((hits(own) - expected) / error, 1.0)


def _middle(words: Words32) -> Doubles:
    return (words & ~_LOW_MASK | (_LOW_MASK + 1) >> 1).view(np.float32).astype(np.float64)


def _cells(words: Words32) -> Doubles:
    """The range of each number's low bits."""
    powers = (words & np.uint32(0x7F800000)).view(np.float32).astype(np.float64)
    return powers * 2.0 ** (DEEPEST + 1 - MANTISSA)


DETECTORS = (bits, agreement, coincidences, steps)
