"""Usable Gaussians, whose low bits can be replaced without a trace.

In a trained model most low bits are uniformly random to anybody who does not know the training, but not all.
A Gaussian is excluded as a whole, so that its numbers stay consistent, because of:

- *Equal steps* away from zero, a sibling or another colour: see `equal_steps`. These are also the harmonics
  of Gaussians that no view shows, and numbers that training freezes in clones.
- *Copies*: Gaussians that share their position, scales, quaternion or the harmonics of degree 1 of a colour
  with any other one, and values that occur too often.
- *Nearly equal* scales, or colours of a harmonic: round and grey Gaussians.
- *Opacities* whose sigmoid is 1, which have no gradient, and those at the edge below which trainers remove
  Gaussians: no trained model has smaller ones.
- *Unit quaternions* among others, as in merged models: new bits would change their length.
- *Short numbers*, five in a Gaussian, as of models in half precision.
- *Small even numbers*, which an optimiser may have left on a coarser grid: see `trailing_zeros`.

docs/threat-model.md has measurements.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch

from keyss.channels.lsb import bits
from keyss.channels.lsb.equal_steps import Steps
from keyss.channels.lsb.trailing_zeros import count_trailing_zeros, least_exponent
from keyss.channels.mixing import row_hashes
from keyss.core.arrays import Bytes, Doubles, Flags, Integers, Words32, among, frequent, repeated
from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.kernels.parallel import in_blocks

# Maximum squared separation (d') of a plain file and one with new bits by small numbers, for an attacker who
# knows the trainer and the plain file's statistics. 0.03 is an AUC of 0.55.
MAX_SEPARATION = 0.03

_MAGNITUDE = np.uint32(0x7FFFFFFF)
# Bit patterns of logits above 16. The sigmoid is 1 above 16.64, but only the exponent never changes.
_SATURATED = np.uint32(0x41800000), np.uint32(0x80000000)
# The logit of 0.005 without low bits.
_PRUNED = np.float32(math.log(0.005 / 0.995)).view(np.uint32) | bits.LOW
_MIN_USABLE = 0.05  # share of the Gaussians of a cover
_SHORT = 5  # numbers without low bits; by chance in one of ten million Gaussians
_SETS_BY_CHANCE = 0.1  # maximum expected number of sets of equal values by chance
_SAMPLE = 20_000  # Gaussians whose bits are tested
_MANTISSAS, _WINDOW = 1 << 22, 1 << 16  # distinct mantissas without the last bit; mantissas of one spectrum
_SMOOTH = 1 << 10  # frequencies that the distribution of the numbers fills
_LARGE = 10 * _SAMPLE  # Gaussians of a cover whose sample is tested first
_CHANCE = 1e-6  # probability of refusing a depth of a model with uniform bits


@dataclass(frozen=True)
class Carriers:
    """The Gaussians of a cover that may be written."""

    ids: Bytes  # [N, 16] of all Gaussians
    usable: Flags  # [N] mask of those in which new low bits do not show
    depth: int  # maximum depth at which new low bits do not show
    renewable: Flags  # [N] mask of those that may be written at the least depth, as salts are

    @staticmethod
    def of(gaussians: Gaussians, layout: bits.Layout) -> Carriers:
        """Raises UsageError, with what shows, if new low bits would show even at the least depth.

        A sample of a large cover is tested first: the whole takes 0.7 s for each 100,000 Gaussians.
        """
        if len(gaussians) > _LARGE:
            sample = gaussians[:: len(gaussians) // _SAMPLE]
            Carriers.of(sample, bits.Layout.of(sample))
        ids = bits.gaussian_ids(gaussians, layout)
        fine = _without_coincidences(gaussians, layout, ids)
        steps = Steps(gaussians, layout)
        equal = steps.equal(bits.DEEPEST)
        fine &= _without_small_even(gaussians, layout, fine & ~equal)
        usable, deepest = fine & ~equal, 0
        for depth in bits.DEPTHS:
            if told := _what_tells(gaussians, layout, usable, depth, steps):
                if depth == bits.LEAST:
                    raise UsageError(told)
                break
            deepest = depth
        return Carriers(ids, usable, deepest, fine & ~steps.equal(bits.LEAST, equal))


def usable_carriers(gaussians: Gaussians) -> Flags:
    """Mask [N] of the usable Gaussians. Raises UsageError as `Carriers.of`."""
    return Carriers.of(gaussians, bits.Layout.of(gaussians)).usable


def _what_tells(gaussians: Gaussians, layout: bits.Layout, usable: Flags, depth: int, steps: Steps) -> str:
    """What tells new low bits of `usable` [N] Gaussians from the model's own; empty for nothing.

    Tested on at most 20,000 Gaussians: see `chance_of_bits` and `Steps.chance`.
    """
    rows = np.flatnonzero(usable)
    if len(rows) <= _MIN_USABLE * len(usable):
        return (
            f"only {len(rows):,} of the cover's {len(usable):,} Gaussians have random low bits; the others "
            "hold short, repeated or predictable values: it was quantised or hardly trained, and new bits "
            "would be seen"
        )
    groups = layout.groups(gaussians[torch.from_numpy(rows[:: max(1, len(rows) // _SAMPLE)])])

    def tests() -> Iterator[tuple[float, str, str]]:
        for name, words in groups.items():
            if words.size:
                relation = f"the low bits of {name} in this cover are not random"
                cause = "quantised, scaled or moved after its training"
                yield chance_of_bits(words, depth + 1), relation, cause
        if depth == bits.LEAST:
            relation = "harmonics of this cover are multiples of one step"
            cause = "multiplied, as by an edit of its brightness"
            yield chance_of_lattice(groups[bits.HARMONICS]), relation, cause
        relation = "numbers of this cover predict each other's low bits"
        cause = "hardly trained, or seen from one direction, so that they moved by equal steps"
        yield steps.chance(depth, usable), relation, cause

    for chance, relation, cause in tests():
        if chance < _CHANCE:
            return f"{relation} (p = {chance:.0e}), and new ones would be seen: the cover was {cause}"
    return ""


def chance_of_bits(words: Words32, width: int) -> float:
    """p-value of bits 1 to `width` - 1 of words [...] under the null hypothesis of uniform bits.

    Exact binomial tests of each bit given exponent, last bit and the bit below, Bonferroni-corrected.
    """
    from scipy.special import bdtr  # takes long to load

    ends = bits.exponents(words).astype(np.int64) << width | words & np.uint32((1 << width) - 1)
    counts = np.bincount(ends.ravel(), minlength=256 << width)
    chances: list[Doubles] = []
    for bit in range(1, width):
        # Axes: exponent, bits above, this bit, the bit below, bits between, last bit (of bit 1, that below).
        last = 2 if bit > 1 else 1
        given = counts.reshape(256, -1, 2, 2, (1 << bit - 1) // last, last).sum(axis=(1, 4))
        ones, times = given[:, 1].ravel(), given.sum(axis=1).ravel()
        ones, times = ones[times > 0], times[times > 0]
        smaller = np.minimum(ones, times - ones)
        chances.append(np.minimum(1, 2 * bdtr(smaller.astype(np.float64), times, 0.5)))
    every = np.concatenate(chances)
    return min(1.0, float(every.min() * len(every)))


def chance_of_lattice(harmonics: Words32) -> float:
    """p-value of harmonics [N, 3 K] on a lattice, for uniform mantissas.

    A factor that is no power of two maps the floats of one exponent to a lattice, whose period shows in the
    power spectrum of the counts of mantissas (Welch 1967). Bonferroni-corrected, over the most frequent
    exponent of each colour.
    """
    from scipy.fft import rfft  # both take long to load
    from scipy.special import gammaincc

    chances = [1.0]
    for colour in range(3 if harmonics.size else 0):
        words = harmonics[:, colour::3].ravel()
        binades = bits.exponents(words)
        words = words[binades == np.bincount(binades).argmax()]
        mantissas = (words >> np.uint32(1)) & np.uint32(_MANTISSAS - 1)  # the last bit is never written
        counts = np.bincount(mantissas, minlength=_MANTISSAS).astype(np.float32).reshape(-1, _WINDOW)
        powers = (np.abs(rfft(counts)[:, _SMOOTH:-1]) ** 2).sum(axis=0)
        # Of uniform mantissas, the power has the mean and at most the variance of a gamma distribution.
        total, squares = len(words), float((counts.sum(axis=1, dtype=np.float64) ** 2).sum())
        shape = total**2 / squares
        chances.append(3 * len(powers) * gammaincc(shape, shape * float(powers.max()) / total))
    return float(min(chances))


def _without_coincidences(gaussians: Gaussians, layout: bits.Layout, ids: Bytes) -> Flags:
    """Mask [N] of Gaussians without shared, frequent, nearly equal, saturated, nearly pruned, short and unit
    numbers."""
    groups, fine = layout.groups(gaussians), np.ones(len(gaussians), bool)
    common = {name: frequent(words, _unlikely_copies(words.size)) for name, words in groups.items()}
    shared = [groups[name] for name in (bits.SCALES, bits.QUATS) if name in groups]
    shared += [groups[bits.HARMONICS][:, colour:9:3] for colour in range(3 if layout.sh_degree else 0)]
    keys = np.empty((len(shared) + 1, len(fine)), np.uint64)
    keys[-1] = ids.view("<u8")[:, 0]

    def judge(start: int, stop: int) -> None:
        for key, words in zip(keys, shared, strict=False):
            key[start:stop] = row_hashes(words[start:stop] & ~bits.LOW)
        good, short = fine[start:stop], np.zeros(stop - start, np.int64)
        for name, every in groups.items():
            words = every[start:stop]
            large = bits.exponents(words)
            good &= ((large > 0) & (large < 254) & ~among(words, common[name])).all(axis=1)
            short += (words & bits.LOW == 0).sum(axis=1)
            if name in (bits.SCALES, bits.HARMONICS):
                high = ((words & _MAGNITUDE) >> np.uint32(bits.DEEPEST + 1)).astype(np.int32)
                threes = high.reshape(len(words), words.shape[1] // 3, 3)
                good &= (np.abs(threes - threes[:, :, [1, 2, 0]]) > 1).all(axis=(1, 2))
            elif name == bits.QUATS:
                good &= np.abs(bits.coarse_lengths(words) - 1) > bits.UNIT_TOLERANCE
            elif name == bits.OPACITIES:
                saturated = (words >= _SATURATED[0]) & (words < _SATURATED[1])
                good &= ~(saturated | (words | bits.LOW == _PRUNED))[:, 0]
        good &= short < _SHORT

    in_blocks(judge, len(fine), bits.BLOCK)
    unique: Flags = ~np.logical_or.reduce(in_blocks(lambda index, _: repeated(keys[index]), len(keys), 1))
    return fine & unique


def _without_small_even(gaussians: Gaussians, layout: bits.Layout, counted: Flags) -> Flags:
    """Mask [N] of Gaussians without small even numbers, by the trailing zeros of those `counted` [N]."""
    groups, fine = layout.groups(gaussians), np.ones(len(gaussians), bool)

    def count(start: int, stop: int) -> Integers:
        mask = counted[start:stop]
        return np.stack([count_trailing_zeros(words[start:stop][mask]) for words in groups.values()])

    counts = np.sum(in_blocks(count, len(fine), bits.BLOCK), axis=0)
    least = [least_exponent(histogram, MAX_SEPARATION / len(bits.ATTRIBUTES)) for histogram in counts]

    def compare(start: int, stop: int) -> None:
        for words, bound in zip(groups.values(), least, strict=True):
            block = words[start:stop]
            fine[start:stop] &= ~((bits.exponents(block) < bound) & (block & 1 == 0)).any(axis=1)

    in_blocks(compare, len(fine), bits.BLOCK)
    return fine


def _unlikely_copies(count: int) -> int:
    """The least c >= 3 for which c equal values are rare among `count` values.

    With 2^26 equally likely values, count^c / c! / 2^(26 (c - 1)) such sets are expected.
    """
    copies = 3
    while count**copies / math.factorial(copies) > _SETS_BY_CHANCE * 2 ** (26 * (copies - 1)):
        copies += 1
    return copies
