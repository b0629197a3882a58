"""Which Gaussians of a model can get new low bits without anybody noticing.

In a trained model most low bits are uniformly random to anybody who does not know the training, but not all.
A Gaussian is left alone as a whole, so that its numbers do not contradict each other, because of:

- *Numbers that are no measurement*: zeros, integers and short fractions, subnormal numbers, and values that
  occur too often (after a few steps of training many are the same small multiple of the learning rate).
- *Saturated opacities*: where float32's sigmoid is 1 its gradient is 0, so that logits of clones stay equal
  while everything else about them changes.
- *Coincidences*: numbers that agree in all bits above the written ones would differ in these afterwards. They
  are near-equal components (grey colours, round Gaussians), harmonics of one colour that are equal several
  times (a Gaussian that few views show gets equal steps), Gaussians that share their scales, their quaternion
  or harmonics of one channel (clones, and channels that training freezes), unit quaternions, and Gaussians
  that occur twice.
- *Equal steps* away from a neighbour: see `siblings`.
- *Opacities at the edge* below which trainers remove Gaussians: no trained model has smaller ones.
- *Small even numbers*, which an optimiser may have left on a coarser grid: see `predictability`.

Coincidences are found in bits that embedding never changes. A Gaussian whose bits are random must hardly ever
be left alone for another reason: embedding makes more such Gaussians by chance, and twice as many as expected
would be noticed.
"""

from __future__ import annotations

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
    identities,
    used_words,
)
from keyss.channels.quiet.predictability import count_trailing_zeros, least_exponent
from keyss.channels.quiet.siblings import moved_apart
from keyss.core.arrays import Bytes, Doubles, Flags, Integers, Numbers, Words, Words32
from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.kernels.parallel import in_blocks

MIN_USABLE = 0.5  # share of the Gaussians of a cover
# Bound of what small numbers give away: squared separation (d') of a plain file and one with new bits, to
# somebody who knows the trainer and the plain file's statistics. 0.03 is an AUC of 0.55.
GIVEN_AWAY = 0.03

_GROUPS = {
    "log scales": slice(0, 3),
    "quaternions": QUATS,
    "opacity logits": slice(7, 8),
    "harmonics": slice(GEOMETRY, None),
}

# A value is a short number when at least so many low bits of its mantissa are zero. By chance one value in a
# million is: only where there are more, these are left alone.
_SHORT_BITS = 20
_SHORT = np.uint32((1 << _SHORT_BITS) - 1)
# A Gaussian is no measurement when so many of its values have 12 zeros; by chance one in three million is.
_ZEROS, _ZERO_FIELDS = np.uint32((1 << 12) - 1), 3
_EQUAL_HARMONICS = 2  # pairs
_MAGNITUDE = np.uint32(0x7FFFFFFF)

_OPACITY = 7
# Bit patterns of logits from 16 on. The sigmoid is 1 from 16.64 on, but only the exponent surely stays.
_SATURATED = np.uint32(0x41800000), np.uint32(0x80000000)
# The logit of 0.005, which trainers prune below, without the bits that may be written.
_PRUNED = np.float32(math.log(0.005 / 0.995)).view(np.uint32) >> np.uint32(GEOMETRY_BITS + UNUSED_BITS)
# Harmonics of a channel in a row: 0.3 % of 20,000 Gaussians share two by chance. Then of larger models.
_FEW_GAUSSIANS, _SHARED_BY_FEW, _SHARED_BY_MANY = 50_000, 2, 3

_EXACT = 1e-6  # of the length of a unit quaternion in single precision
# Sets of equal values that there may be by chance: they are left alone, and embedding makes as many again.
_SETS_BY_CHANCE = 0.1
_SAMPLE = 20_000  # Gaussians whose bits are tested
_CHANCE = 1e-6  # that a model with uniform bits is refused


def usable_carriers(gaussians: Gaussians) -> Flags:
    """[N] which Gaussians have low bits that look like those of trained values, and can be replaced."""
    return named_carriers(gaussians, Layout.of(gaussians))[0]


def named_carriers(gaussians: Gaussians, layout: Layout) -> tuple[Flags, Bytes]:
    """`usable_carriers` [N], and all `identities` [N, 16]."""
    with ThreadPoolExecutor(1) as helper:
        counting = helper.submit(_frequent_values, gaussians)  # most of which is done without Python's lock
        names = identities(gaussians, layout)
        often = counting.result()
    usable, short = _apart(gaussians, layout, names)

    def judge(start: int, stop: int) -> Integers:
        used, own = used_words(gaussians[start:stop]), usable[start:stop]
        own &= _are_measured(used, layout, often, short) & ~near_equal(used, layout)
        if layout.quats:
            own &= ~_have_unit_length(used)
        return np.stack([count_trailing_zeros(used[:, group], own) for group in _GROUPS.values()])

    parts = in_blocks(judge, len(gaussians), BLOCK)
    if not parts:
        return usable, names
    usable &= ~moved_apart(gaussians, usable)
    least = [least_exponent(counts, GIVEN_AWAY / len(_GROUPS)) for counts in np.sum(parts, axis=0)]

    def leave_small(start: int, stop: int) -> None:
        used = used_words(gaussians[start:stop])
        for group, bound in zip(_GROUPS.values(), least, strict=True):
            if layout.quats or group != QUATS:
                values = used[:, group]
                usable[start:stop] &= ~((exponents(values) < bound) & (values & 1 == 0)).any(axis=1)

    in_blocks(leave_small, len(gaussians), BLOCK)
    return usable, names


def check_usable(gaussians: Gaussians, usable: Flags, layout: Layout | None = None) -> None:
    """Raise UsageError unless half of the Gaussians are `usable` [N], and their low bits uniform.

    Tested on at most 20,000 Gaussians: see `chance_of_bits`.
    """
    share = float(usable.mean()) if len(usable) else 0.0
    if share < MIN_USABLE:
        raise UsageError(
            f"only {share:.0%} of the cover's Gaussians have random low bits; the others hold short, "
            "repeated or predictable values: it was quantised or hardly trained, and new bits would be seen"
        )
    layout, rows = layout or Layout.of(gaussians), np.flatnonzero(usable)
    used = used_words(gaussians[torch.from_numpy(rows[:: max(1, len(rows) // _SAMPLE)])])
    for name, group in _GROUPS.items():
        bits = int(layout.mask[group][:1].max(initial=0)).bit_length()
        if bits and used[:, group].size and chance_of_bits(used[:, group], bits) < _CHANCE:
            raise UsageError(
                f"the low bits of {name} in this cover are not random (p < {_CHANCE:g}), and nothing can be "
                "hidden in them: the cover was quantised, scaled or moved after its training"
            )


def chance_of_bits(words: Words32, bits: int) -> float:
    """The probability of bits 1 to `bits` - 1 of words [...] if all of them are uniform.

    Exactly, of the most unlikely one given exponent, last bit and the bit below it; times their number.
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


def exponents(words: Words32) -> Bytes:
    """[...] the biased binary exponents."""
    return (words >> np.uint32(23) & np.uint32(255)).astype(np.uint8)


def near_equal(used: Words32, layout: Layout) -> Flags:
    """[N] whether two scales, two components of a quaternion or two channels of a colour are nearly equal.

    Or two pairs of one colour's harmonics equal. By chance some 4 % of all Gaussians are. `used` [N, F]: of
    `used_words`.
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
    """[V] which values at least `times` of the unsigned integers [...] have, in ascending order."""
    ordered, further = np.sort(words, axis=None), times - 1
    return np.unique(ordered[further:][ordered[further:] == ordered[: max(0, len(ordered) - further)]])


def repeated(values: Words) -> Flags:
    """[N] which of the values [N] occur at least twice."""
    return among(values, frequent(values, 2))


def among(values: Numbers, ordered: Numbers) -> Flags:
    """[...] which of the values [...] are among others in ascending order; faster than `np.isin`."""
    if not len(ordered):
        return np.zeros(values.shape, bool)
    result: Flags = ordered[np.searchsorted(ordered, values).clip(max=len(ordered) - 1)] == values
    return result


def _are_measured(used: Words32, layout: Layout, often: list[Words32], short: bool) -> Flags:
    """[N] whether no number is subnormal, frequent, a saturated or pruned opacity, and few have many zeros.

    If `short`, none has.
    """
    large = exponents(used)
    fine = (large > 0) & (large < 254)
    opacity = used[:, _OPACITY]
    fine[:, _OPACITY] &= ~((opacity >= _SATURATED[0]) & (opacity < _SATURATED[1]))
    fine[:, _OPACITY] &= opacity >> np.uint32(GEOMETRY_BITS + UNUSED_BITS) != _PRUNED
    if short:
        fine &= (used & _SHORT) != 0
    for group, values in zip(_GROUPS.values(), often, strict=True):
        fine[:, group] &= ~among(used[:, group], values)
    zeros = ((used & _ZEROS) == 0)[:, layout.columns].sum(axis=1)
    measured: Flags = fine[:, layout.columns].all(axis=1) & (zeros < _ZERO_FIELDS)
    return measured


def _have_unit_length(used: Words32) -> Flags:
    """[N] which quaternions have unit length, and could have it with any low bits."""
    words = np.ascontiguousarray(used[:, QUATS])
    near = np.abs(coarse_lengths(words) - 1) < UNIT_TOLERANCE
    lengths = np.linalg.norm(np.where(near[:, None], words.view(np.float32).astype(np.float64), 0), axis=1)
    unit: Flags = near & (np.abs(lengths - 1) < _EXACT)
    return unit


def _apart(gaussians: Gaussians, layout: Layout, names: Bytes) -> tuple[Flags, bool]:
    """[N] whether neither the Gaussian, its scales, its quaternion nor harmonics of a channel occur twice.

    Harmonics: two in a row, numbers 1 and 2, 3 and 4 and so on, or three in large models. Then whether there
    are more short values than by chance.
    """
    together = [slice(0, 3), *([QUATS] if layout.quats else [])]
    width = 3 * (_SHARED_BY_FEW if len(gaussians) <= _FEW_GAUSSIANS else _SHARED_BY_MANY)
    for first in range(GEOMETRY, len(layout.mask) - width + 1, width):
        together += [slice(first + channel, first + width, 3) for channel in range(3)]
    keys = np.empty((len(together) + 1, len(gaussians)), np.uint64)
    keys[-1] = names.view("<u8")[:, 0]

    stays, used_fields = ~layout.mask & ~np.uint32(1), np.isin(np.arange(len(layout.mask)), layout.columns)

    def hash_some(start: int, stop: int) -> int:
        used = used_words(gaussians[start:stop])
        high = used & stays
        for key, columns in zip(keys, together, strict=False):
            key[start:stop] = row_hashes(high[:, columns])
        rows, fields = np.nonzero(used & _SHORT == 0)  # few
        return int(np.count_nonzero(used_fields[fields] & (exponents(used[rows, fields]) > 0)))

    short = sum(in_blocks(hash_some, len(gaussians), BLOCK))
    apart = ~np.logical_or.reduce(in_blocks(lambda index, _: repeated(keys[index]), len(keys), 1))
    expected = len(gaussians) * len(layout.columns) / 2.0**_SHORT_BITS
    return apart, short > expected + 5 * (expected + 1) ** 0.5


def _frequent_values(gaussians: Gaussians) -> list[Words32]:
    """For each group of fields [V] the values that occur more often than is likely, in ascending order."""
    fields = (gaussians.log_scales, gaussians.quats, gaussians.opacity_logits, gaussians.sh[:, 1:])
    every = [field.detach().to("cpu", torch.float32).numpy().view(np.uint32) for field in fields]
    return [
        frequent(words.reshape(len(words), math.prod(words.shape[1:])), _unlikely_copies(words.size))
        for words in every
    ]


def _unlikely_copies(count: int) -> int:
    """The least c from 3 on so that sets of c equal ones are rare among `count` values.

    For 2^26 equally likely values there would be count^c / c! / 2^(26 (c - 1)) such sets.
    """
    copies = 3
    while count**copies / math.factorial(copies) > _SETS_BY_CHANCE * 2 ** (26 * (copies - 1)):
        copies += 1
    return copies
