"""Which Gaussians of a model can get new low bits without anybody noticing.

In a trained model the low bits are uniformly random for everybody who does not know how it was trained, but
not all of them. A Gaussian is left alone, as a whole, so that none contradicts itself, for one of these:

- *Numbers that are no measurement*: zeros, integers and short fractions, subnormal numbers, and values that
  occur too often (after a few steps of training many are the same small multiple of the learning rate).
- *Coincidences*: numbers that agree in all bits above the written ones would agree in nothing else
  afterwards. These are near-equal components (grey colours, round Gaussians), harmonics of one colour that
  are equal several times (a Gaussian that few views show gets equal steps), Gaussians that share whole
  triples of numbers (clones that training hardly moved apart), unit quaternions, and Gaussians that occur
  twice.
- *Small even numbers*, which an optimiser may have left on a coarser grid: see `predictability`.

Coincidences are found in what embedding leaves as it is. A Gaussian whose bits are random must hardly ever be
left alone for any other reason: what is left stays, embedding makes more of the same kind by chance, and
twice as many as expected would be seen.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from scipy.special import bdtr

from keyss.channels.low_bits import kernels
from keyss.channels.low_bits.bits import (
    FIELDS,
    GEOMETRY,
    KERNEL_BLOCK,
    QUATS,
    UNIT_TOLERANCE,
    UNUSED_BITS,
    Bytes,
    Flags,
    Layout,
    Words,
    identities,
    used_words,
    words_of,
)
from keyss.channels.low_bits.multiples import crowded, repeated
from keyss.channels.low_bits.predictability import EXPONENTS, MOST_ZEROS, Counts, least_exponent
from keyss.core.errors import InputError
from keyss.core.gaussians import Gaussians
from keyss.rendering.cpu.parallel import in_blocks

LEAST_USABLE = 0.5  # share of the Gaussians of a cover
# What small numbers may give away: squared separation (d') of a plain file and one with new bits, to somebody
# who knows the trainer and the plain file's statistics. 0.03 is an AUC of 0.55.
GIVEN_AWAY = 0.03

_GROUPS = (slice(0, 3), QUATS, slice(7, 8), slice(8, None))  # scales, quaternions, opacity, harmonics
_GROUP_NAMES = ("log scales", "quaternions", "opacity logits", "harmonics")

# A value is not random, but a short number, when at least this many low bits of its mantissa are zero. By
# chance that happens to one value in a million; where there are no more of them than that, it is chance.
_SHORT_BITS = 20
# Nor is a Gaussian, when so many of its values have 12 zeros; by chance one in three million is that.
_ZERO_FIELDS = 3

_EXACT = 1e-6  # of the length of a unit quaternion in single precision
# Sets of equal values that there may be by chance: those are left alone, and embedding makes as many again.
_SETS_BY_CHANCE = 0.1
_SAMPLE = 20_000
_SHIFTS = (UNUSED_BITS, UNUSED_BITS + 4)  # two overlapping bytes
_LARGEST_RATIO = 2.0  # chi-square over degrees of freedom; 0.7 to 1.3 in trained models, above 50 in others
_CHANCE = 1e-6  # that a model with uniform bits is refused


def usable_carriers(gaussians: Gaussians, names: Bytes | None = None, layout: Layout | None = None) -> Flags:
    """[N] which Gaussians have low bits that look like those of trained values, and can be replaced.

    `names` [N, 16]: their identities, where they are known.
    """
    layout = layout or Layout.of(gaussians)
    fields, count = words_of(gaussians)[1:], len(gaussians)
    usable, short = _apart(gaussians, layout, identities(gaussians, layout) if names is None else names)
    frequent = _frequent_values(gaussians)
    ends = np.cumsum([0, *map(len, frequent)])
    values, groups = np.concatenate(frequent), _group_of_fields(len(layout.mask))
    mask, shifts, quats = layout.mask, layout.shifts, layout.quats

    def judge(start: int, stop: int) -> Counts:
        counts = np.zeros((len(_GROUPS), EXPONENTS, MOST_ZEROS + 1), np.int64)
        of_fields = (mask, shifts, groups, quats, short, values, ends)
        limits = (_ZERO_FIELDS, UNIT_TOLERANCE, _EXACT)
        kernels.judge(start, stop, *fields, *of_fields, *limits, usable, counts)
        return counts

    parts = in_blocks(judge, count, KERNEL_BLOCK)
    if not parts:
        return usable
    counts = np.sum(parts, axis=0)
    least = np.array([least_exponent(each, GIVEN_AWAY / len(_GROUPS)) for each in counts])
    in_blocks(
        lambda start, stop: kernels.leave_small(start, stop, *fields, groups, quats, least, usable),
        count,
        KERNEL_BLOCK,
    )
    return usable


def check_usable(gaussians: Gaussians, usable: Flags, layout: Layout | None = None) -> None:
    """Raise InputError unless half of the Gaussians are `usable` [N], with uniform low bits in every field.

    Uniform: chi-square of the frequencies of two overlapping bytes, and every bit given the field's exponent,
    the last bit and the bit below; over at most 20,000 Gaussians.
    """
    if not len(usable) or usable.mean() < LEAST_USABLE:
        share = usable.mean() if len(usable) else 0.0
        raise InputError(
            f"only {share:.0%} of the Gaussians have random low bits; the others hold short, repeated or "
            "predictable values: the model was quantised or hardly trained, and what is put there could be "
            "seen"
        )
    layout, rows = layout or Layout.of(gaussians), np.flatnonzero(usable)
    rows = rows[:: max(1, len(rows) // _SAMPLE)]
    used = used_words(gaussians[torch.from_numpy(rows)])
    for column in layout.columns:
        ratio = max(_chi_square(used[:, column] >> shift & 255) for shift in _SHIFTS)
        if ratio > _LARGEST_RATIO:
            name = FIELDS[column] if column < GEOMETRY else "f_rest"
            raise InputError(
                f"the low bits of {name} are not random in this model (chi-square "
                f"{ratio:.1f} per degree of freedom, 1 expected), so that nothing can be hidden in them: "
                "it was quantised, scaled or moved after its training"
            )
    for name, group in zip(_GROUP_NAMES, _GROUPS, strict=True):
        if layout.quats or group != QUATS:
            bits = int(layout.mask[group][:1].max(initial=0)).bit_length()
            if used[:, group].size and (chance := chance_of_bits(used[:, group], bits)) < _CHANCE:
                raise InputError(
                    f"the low bits of {name} are not random in this model: they depend on the size of the "
                    f"numbers or on each other (by chance that happens with p = {chance:.0e}), so that "
                    "nothing can be hidden in them"
                )


def is_uniform(values: npt.NDArray[np.float32]) -> bool:
    """Whether one property [N] has low bits whose bytes are uniform."""
    words = np.ascontiguousarray(values[:: max(1, len(values) // _SAMPLE)]).view(np.uint32)
    return all(_chi_square(words >> shift & 255) <= _LARGEST_RATIO for shift in _SHIFTS)


def chance_of_bits(words: Words, bits: int) -> float:
    """How likely bits 1 to `bits` - 1 of words [...] are what they are, if all of them are uniform.

    Exactly, of the most unlikely one given exponent, last bit and the bit below it; times how many there are.
    """
    flat = words.ravel()
    context = exponents(flat).astype(np.int64) << 2 | (flat & 1).astype(np.int64) << 1
    chances: list[npt.NDArray[np.float64]] = []
    for bit in range(UNUSED_BITS, bits):
        below = (flat >> np.uint32(bit - 1) & 1).astype(np.int64) if bit > 1 else 0
        times = np.bincount(context | below, minlength=1024)
        ones = np.bincount((context | below)[(flat >> np.uint32(bit) & 1) == 1], minlength=1024)
        ones, times = ones[times > 0], times[times > 0]
        smaller = np.minimum(ones, times - ones)
        chances.append(np.minimum(1, 2 * bdtr(smaller.astype(np.float64), times, 0.5)))
    every = np.concatenate(chances)
    return min(1.0, float(every.min() * len(every)))


def exponents(words: Words) -> npt.NDArray[np.uint8]:
    """[...] the biased binary exponents."""
    return (words >> np.uint32(23) & np.uint32(255)).astype(np.uint8)


def _apart(gaussians: Gaussians, layout: Layout, names: Bytes) -> tuple[Flags, bool]:
    """[N] whether neither the Gaussian, its scales, its quaternion nor two harmonics in a row occur twice.

    Of harmonics, those with numbers 1 and 2, 3 and 4 and so on, of all colours. Decided by the bits that
    embedding leaves. Then whether there are more short values than by chance.
    """
    fields, count = words_of(gaussians)[1:], len(gaussians)
    keys = np.empty((2 + layout.quats + (len(layout.mask) - GEOMETRY) // 6, count), np.uint64)
    keys[-1] = names.view("<u8")[:, 0]
    short = in_blocks(
        lambda start, stop: kernels.triples(start, stop, *fields, layout.mask, layout.quats, keys[:-1]),
        count,
        KERNEL_BLOCK,
    )
    apart = ~np.logical_or.reduce(in_blocks(lambda index, _: repeated(keys[index]), len(keys), 1))
    expected = count * len(layout.columns) / 2.0**_SHORT_BITS
    return apart, bool(sum(short) > expected + 5 * (expected + 1) ** 0.5)


def _frequent_values(gaussians: Gaussians) -> list[Words]:
    """For each group of fields [V] the values that occur more often than is likely, in ascending order."""
    scales, quats, opacities, sh = words_of(gaussians)[1:]
    found = []
    for words, first in ((scales, 0), (quats, 0), (opacities[:, None], 0), (sh, 3)):
        copies = _unlikely_copies(words[:, first:].size)
        flat = np.sort(crowded(words, first, copies))
        found.append(
            np.unique(flat[copies - 1 :][flat[copies - 1 :] == flat[: max(0, len(flat) - copies + 1)]])
        )
    return found


def _group_of_fields(count: int) -> npt.NDArray[np.int64]:
    """[count] the group of each field."""
    groups = np.zeros(count, np.int64)
    for number, each in enumerate(_GROUPS):
        groups[each] = number
    return groups


def _unlikely_copies(count: int) -> int:
    """The least c from 3 on so that sets of c equal ones are rare among `count` values.

    For 2^26 equally likely values there would be count^c / c! / 2^(26 (c - 1)) such sets.
    """
    copies = 3
    while count**copies / math.factorial(copies) > _SETS_BY_CHANCE * 2 ** (26 * (copies - 1)):
        copies += 1
    return copies


def _chi_square(bytes_: npt.NDArray[np.integer[Any]]) -> float:
    """Per degree of freedom, of the frequencies of numbers below 256."""
    counts = np.bincount(bytes_, minlength=256)
    expected = len(bytes_) / 256
    return float(((counts - expected) ** 2).sum() / expected / 255)
