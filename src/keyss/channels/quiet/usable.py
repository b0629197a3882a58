"""Usable Gaussians, whose low bits can be replaced without a trace, and those that give the salts.

In a trained model most low bits are uniformly random to anybody who does not know the training, but not all.
A Gaussian is excluded as a whole, so that its numbers stay consistent, because of:

- *Untrained numbers*: zeros, integers and short fractions, subnormal numbers, and values that occur too
  often (after few training steps many are the same small multiple of the learning rate).
- *Saturated opacities*: where float32's sigmoid is 1 its gradient is 0, so that logits of clones stay equal
  while everything else about them changes.
- *Coincidences*: numbers that agree in all bits above the written ones would differ in these afterwards. They
  are near-equal components (grey colours, round Gaussians), harmonics of one colour that are equal several
  times (a Gaussian that few views show gets equal steps), Gaussians that share their scales, their quaternion
  or harmonics of one channel (clones, and channels that training freezes), unit quaternions, and Gaussians
  that occur twice.
- *Equal steps* away from a neighbour: see `predictability`.
- *Opacities at the edge* below which trainers remove Gaussians: no trained model has smaller ones.
- *Small even numbers*, which an optimiser may have left on a coarser grid: see `predictability`.

Coincidences are found in bits that embedding never changes. Otherwise false exclusions must be rare:
embedding makes as many such Gaussians again by chance, and twice the expected number would be noticed.

A *salt* of Argon2id is a hash of one Gaussian and its low bits, which are new random bits for every file and
carry nothing else: no two files of one cover share a salt. There are several salts because Gaussians may be
removed. Their order does not change by embedding: first Gaussians without small harmonics and coincidences,
which are rarely excluded, and among these the smallest IDs.
"""

from __future__ import annotations

import hashlib
import math
from concurrent.futures import ThreadPoolExecutor
from itertools import combinations

import numpy as np
import torch

from keyss.channels.mixing import row_hashes
from keyss.channels.quiet.bits import (
    BLOCK,
    GEOMETRY,
    GEOMETRY_BITS,
    QUATS,
    UNIT_TOLERANCE,
    UNUSED_BITS,
    Layout,
    coarse_lengths,
    gaussian_ids,
    group_words,
    read_low_bits,
    used_words,
)
from keyss.channels.quiet.predictability import (
    chance_of_equal_steps,
    count_trailing_zeros,
    find_siblings,
    least_exponent,
)
from keyss.core.arrays import Bytes, Doubles, Flags, Integers, Numbers, Words, Words32
from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.kernels.parallel import in_blocks
from keyss.keys.derivation import SALT_BYTES

SALTS = 12  # random pruning of a quarter removes all their Gaussians with p = 6e-8
_LABEL = b"keyss/v2/salt"
_MIN_USABLE = 0.5  # share of the Gaussians of a cover
# Maximum squared separation (d') of a plain file and one with new bits by small numbers, for an attacker who
# knows the trainer and the plain file's statistics. 0.03 is an AUC of 0.55.
MAX_SEPARATION = 0.03

_GROUPS = {
    "log scales": slice(0, 3),
    "quaternions": QUATS,
    "opacity logits": slice(7, 8),
    "harmonics": slice(GEOMETRY, None),
}

# A short number has at least this many trailing zeros. One in a million does by chance: short numbers are
# excluded only if there are more.
_SHORT_BITS = 20
_SHORT = np.uint32((1 << _SHORT_BITS) - 1)
# A Gaussian is untrained if this many values have 12 trailing zeros; by chance one in three million is.
_ZEROS, _ZERO_FIELDS = np.uint32((1 << 12) - 1), 3
_EQUAL_HARMONICS = 2  # pairs
_MAGNITUDE, _MANTISSA = np.uint32(0x7FFFFFFF), np.uint32((1 << 23) - 1)

_OPACITY = 7
# Bit patterns of logits above 16. The sigmoid is 1 above 16.64, but only the exponent never changes.
_SATURATED = np.uint32(0x41800000), np.uint32(0x80000000)
# The logit of 0.005, below which trainers prune, without the bits that may be written.
_PRUNED = np.float32(math.log(0.005 / 0.995)).view(np.uint32) >> np.uint32(GEOMETRY_BITS + UNUSED_BITS)
# Consecutive harmonics of a channel that clones share, in small and large models. By chance 0.3 % of 20,000
# Gaussians share two.
_FEW_GAUSSIANS, _SHARED_BY_FEW, _SHARED_BY_MANY = 50_000, 2, 3

_EXACT = 1e-6  # error of the length of a unit quaternion in single precision
# Maximum expected number of sets of equal values by chance.
_SETS_BY_CHANCE = 0.1
_SAMPLE = 20_000  # Gaussians whose bits are tested
_LARGE = 10 * _SAMPLE  # Gaussians of a cover whose sample is tested first
_CHANCE = 1e-6  # probability of refusing a model with uniform bits


def usable_carriers(gaussians: Gaussians) -> Flags:
    """Mask [N] of the usable Gaussians."""
    return usable_with_ids(gaussians, Layout.of(gaussians))[0]


def usable_with_ids(gaussians: Gaussians, layout: Layout) -> tuple[Flags, Bytes]:
    """`usable_carriers` [N], and all `gaussian_ids` [N, 16]."""
    with ThreadPoolExecutor(1) as helper:
        counting = helper.submit(_frequent_values, gaussians)  # mostly without the GIL
        ids = gaussian_ids(gaussians, layout)
        common = counting.result()
    usable, short = _are_unique(gaussians, layout, ids)

    def judge(start: int, stop: int) -> Integers:
        used, own = used_words(gaussians[start:stop]), usable[start:stop]
        own &= _are_trained(used, layout, common, short) & ~near_equal(used, layout)
        if layout.quats:
            own &= ~_have_unit_length(used)
        return np.stack([count_trailing_zeros(used[:, group], own) for group in _GROUPS.values()])

    parts = in_blocks(judge, len(gaussians), BLOCK)
    if not parts:
        return usable, ids
    usable &= ~find_siblings(gaussians, usable)
    least = [least_exponent(counts, MAX_SEPARATION / len(_GROUPS)) for counts in np.sum(parts, axis=0)]

    def exclude_small(start: int, stop: int) -> None:
        used = used_words(gaussians[start:stop])
        for group, bound in zip(_GROUPS.values(), least, strict=True):
            if layout.quats or group != QUATS:
                values = used[:, group]
                usable[start:stop] &= ~((exponents(values) < bound) & (values & 1 == 0)).any(axis=1)

    in_blocks(exclude_small, len(gaussians), BLOCK)
    return usable, ids


def check_sample(gaussians: Gaussians) -> None:
    """Raise the UsageError of `check_usable` for a large cover if its sample alone is refused.

    Which Gaussians are usable takes a second per 100,000. More of them are in the sample, as fewer repeat.
    """
    if len(gaussians) > _LARGE:
        sample = gaussians[:: len(gaussians) // _SAMPLE]
        layout = Layout.of(sample)
        _check_bits(sample, usable_with_ids(sample, layout)[0], layout)


def check_usable(gaussians: Gaussians, usable: Flags, layout: Layout) -> None:
    """Raise UsageError unless half of the Gaussians are `usable` [N], and their low bits uniform.

    Tested on at most 20,000 Gaussians: see `chance_of_bits` and `chance_of_equal_steps`.
    """
    _check_bits(gaussians, usable, layout)
    if chance_of_equal_steps(gaussians, usable) < _CHANCE:
        raise UsageError(
            f"harmonics of this cover tell each other's low bits (p < {_CHANCE:g}), and new bits would be "
            "seen: training saw most Gaussians from one direction"
        )


def _check_bits(gaussians: Gaussians, usable: Flags, layout: Layout) -> None:
    share = float(usable.mean()) if len(usable) else 0.0
    if share < _MIN_USABLE:
        raise UsageError(
            f"only {share:.0%} of the cover's Gaussians have random low bits; the others hold short, "
            "repeated or predictable values: it was quantised or hardly trained, and new bits would be seen"
        )
    rows = np.flatnonzero(usable)
    used = used_words(gaussians[torch.from_numpy(rows[:: max(1, len(rows) // _SAMPLE)])])
    for name, group in _GROUPS.items():
        bits = int(layout.mask[group][:1].max(initial=0)).bit_length()
        if bits and used[:, group].size and chance_of_bits(used[:, group], bits) < _CHANCE:
            raise UsageError(
                f"the low bits of {name} in this cover are not random (p < {_CHANCE:g}), and nothing can be "
                "hidden in them: the cover was quantised, scaled or moved after its training"
            )


def chance_of_bits(words: Words32, bits: int) -> float:
    """p-value of bits 1 to `bits` - 1 of words [...] under the null hypothesis of uniform bits.

    Exact binomial tests of each bit given exponent, last bit and the bit below, Bonferroni-corrected.
    """
    from scipy.special import bdtr  # takes long to load

    flat = words.ravel()
    context = exponents(flat).astype(np.int64) << 2 | (flat & 1).astype(np.int64) << 1
    chances: list[Doubles] = []
    for bit in range(UNUSED_BITS, bits):
        below = (flat >> np.uint32(bit - 1) & 1).astype(np.int64) if bit > 1 else 0
        times = np.bincount(context | below, minlength=1024)
        ones = np.bincount((context | below)[(flat >> np.uint32(bit) & 1) == 1], minlength=1024)
        ones, times = ones[times > 0], times[times > 0]
        smaller = np.minimum(ones, times - ones)
        chances.append(np.minimum(1, 2 * bdtr(smaller.astype(np.float64), times, 0.5)))
    every = np.concatenate(chances)
    return min(1.0, float(every.min() * len(every)))


def salt_rows(gaussians: Gaussians, ids: Bytes, layout: Layout) -> Integers:
    """Rows of the salts' Gaussians, at most SALTS, in the order of the salts; `ids` [N, 16]."""
    ranks = _ranks(gaussians, layout)
    # 9 bits of rank, 55 of the ID.
    keys = ranks << np.uint64(55) | ids[:, :8].copy().view(">u8")[:, 0].astype(np.uint64) >> np.uint64(9)
    best = np.argpartition(keys, SALTS - 1)[:SALTS] if len(keys) > SALTS else np.arange(len(keys))
    low = read_low_bits(gaussians[torch.from_numpy(best)], layout)
    order = sorted(range(len(best)), key=lambda i: (ranks[best[i]], ids[best[i]].tobytes(), low[i].tobytes()))
    return best[order]


def salt(carrier_id: Bytes, low: Bytes) -> bytes:
    """The salt of one carrier: SALT_BYTES."""
    return hashlib.sha256(_LABEL + carrier_id.tobytes() + low.tobytes()).digest()[:SALT_BYTES]


def exponents(words: Words32) -> Bytes:
    """[...] the biased binary exponents."""
    return (words >> np.uint32(23) & np.uint32(255)).astype(np.uint8)


def near_equal(used: Words32, layout: Layout) -> Flags:
    """Mask [N] of Gaussians with nearly equal scales, quaternion components or channels of a harmonic.

    Also of those with two pairs of equal harmonics, each in one channel. By chance it selects about 4 %.
    `used` [N, F]: the result of `used_words`.
    """
    high = np.ascontiguousarray(((used & _MAGNITUDE) >> layout.shifts).astype(np.int32).T)
    harmonics = high[GEOMETRY:].reshape(-1, 3, len(used))
    near, equal = np.zeros(len(used), bool), np.zeros(len(used), np.int16)
    for values in (high[:3], *([high[QUATS]] if layout.quats else []), *harmonics):
        for one, other in combinations(values, 2):
            near |= np.abs(one - other) <= 1
    for first, second in combinations(harmonics, 2):
        equal += (first == second).sum(axis=0, dtype=np.int16)
    return near | (equal >= _EQUAL_HARMONICS)


def frequent(words: Numbers, times: int) -> Numbers:
    """[V] values that occur at least `times` times among `words` [...], in ascending order."""
    ordered, further = np.sort(words, axis=None), times - 1
    return np.unique(ordered[further:][ordered[further:] == ordered[: max(0, len(ordered) - further)]])


def repeated(values: Words) -> Flags:
    """Mask [N] of the values [N] that occur at least twice."""
    return among(values, frequent(values, 2))


def among(values: Numbers, ordered: Numbers) -> Flags:
    """Mask [...] of the values [...] that are in `ordered`, in ascending order; faster than `np.isin`."""
    if not len(ordered):
        return np.zeros(values.shape, bool)
    result: Flags = ordered[np.searchsorted(ordered, values).clip(max=len(ordered) - 1)] == values
    return result


def _are_trained(used: Words32, layout: Layout, common: list[Words32], short: bool) -> Flags:
    """Mask [N] of Gaussians with no subnormal or frequent number, and no saturated or nearly pruned opacity.

    Few numbers may end in many zeros; if `short`, none may be short.
    """
    large = exponents(used)
    fine = (large > 0) & (large < 254)
    opacity = used[:, _OPACITY]
    fine[:, _OPACITY] &= ~((opacity >= _SATURATED[0]) & (opacity < _SATURATED[1]))
    fine[:, _OPACITY] &= opacity >> np.uint32(GEOMETRY_BITS + UNUSED_BITS) != _PRUNED
    if short:
        fine &= (used & _SHORT) != 0
    for group, values in zip(_GROUPS.values(), common, strict=True):
        fine[:, group] &= ~among(used[:, group], values)
    zeros = ((used & _ZEROS) == 0)[:, layout.columns].sum(axis=1)
    trained: Flags = fine[:, layout.columns].all(axis=1) & (zeros < _ZERO_FIELDS)
    return trained


def _have_unit_length(used: Words32) -> Flags:
    """Mask [N] of quaternions of unit length."""
    words = np.ascontiguousarray(used[:, QUATS])
    near = np.abs(coarse_lengths(words) - 1) < UNIT_TOLERANCE
    lengths = np.linalg.norm(np.where(near[:, None], words.view(np.float32).astype(np.float64), 0), axis=1)
    unit: Flags = near & (np.abs(lengths - 1) < _EXACT)
    return unit


def _are_unique(gaussians: Gaussians, layout: Layout, ids: Bytes) -> tuple[Flags, bool]:
    """Mask [N] of Gaussians that share no scales, quaternion or harmonics of a channel with another one.

    Harmonics are compared in consecutive pairs, in large models in triples. Also returns whether there are
    more short values than by chance.
    """
    shared_columns = [slice(0, 3), *([QUATS] if layout.quats else [])]
    width = 3 * (_SHARED_BY_FEW if len(gaussians) <= _FEW_GAUSSIANS else _SHARED_BY_MANY)
    for first in range(GEOMETRY, len(layout.mask) - width + 1, width):
        shared_columns += [slice(first + channel, first + width, 3) for channel in range(3)]
    keys = np.empty((len(shared_columns) + 1, len(gaussians)), np.uint64)
    keys[-1] = ids.view("<u8")[:, 0]

    stays, used_fields = ~layout.mask & ~np.uint32(1), np.isin(np.arange(len(layout.mask)), layout.columns)

    def hash_some(start: int, stop: int) -> int:
        used = used_words(gaussians[start:stop])
        high = used & stays
        for key, columns in zip(keys, shared_columns, strict=False):
            key[start:stop] = row_hashes(high[:, columns])
        rows, fields = np.nonzero(used & _SHORT == 0)  # few
        return int(np.count_nonzero(used_fields[fields] & (exponents(used[rows, fields]) > 0)))

    short = sum(in_blocks(hash_some, len(gaussians), BLOCK))
    unique = ~np.logical_or.reduce(in_blocks(lambda index, _: repeated(keys[index]), len(keys), 1))
    expected = len(gaussians) * len(layout.columns) / 2.0**_SHORT_BITS
    return unique, short > expected + 5 * (expected + 1) ** 0.5


def _frequent_values(gaussians: Gaussians) -> list[Words32]:
    """For each group of fields the values [V] that occur too often, in ascending order."""
    return [frequent(words, _unlikely_copies(words.size)) for words in group_words(gaussians)]


def _unlikely_copies(count: int) -> int:
    """The least c >= 3 for which c equal values are rare among `count` values.

    With 2^26 equally likely values, count^c / c! / 2^(26 (c - 1)) such sets are expected.
    """
    copies = 3
    while count**copies / math.factorial(copies) > _SETS_BY_CHANCE * 2 ** (26 * (copies - 1)):
        copies += 1
    return copies


def _ranks(gaussians: Gaussians, layout: Layout) -> Words:
    """[N] 0 to 511, lower first: 256 if doubtful, plus 255 minus the exponent of the least harmonic."""
    columns = layout.columns
    stays = layout.mask[columns] | np.uint32(1)

    def ranked(start: int, stop: int) -> Words:
        used = used_words(gaussians[start:stop])
        chosen = used[:, columns]
        large = exponents(chosen)
        doubtful = ((large == 0) | (chosen & _MANTISSA & ~stays == 0)).any(axis=1) | near_equal(used, layout)
        if layout.quats:
            doubtful |= np.abs(coarse_lengths(used[:, QUATS]) - 1) < UNIT_TOLERANCE
        harmonics = exponents(used[:, GEOMETRY:]) if used.shape[1] > GEOMETRY else large
        rank: Words = (255 - harmonics.min(axis=1) + 256 * doubtful).astype(np.uint64)
        return rank

    return np.concatenate([np.zeros(0, np.uint64), *in_blocks(ranked, len(gaussians), BLOCK)])
