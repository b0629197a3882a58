"""What the kernels of low bits compute, by numpy and hashlib: slow, and plain to read."""

from __future__ import annotations

import hashlib
from itertools import combinations

import numpy as np
import numpy.typing as npt

from keyss.channels.low_bits.bits import (
    GEOMETRY,
    QUATS,
    UNIT_TOLERANCE,
    UNUSED_BITS,
    Bytes,
    Flags,
    Layout,
    Words,
    coarse_lengths,
    used_words,
    words_of,
)
from keyss.channels.low_bits.predictability import count_trailing_zeros, least_exponent
from keyss.channels.low_bits.usable import GIVEN_AWAY, _unlikely_copies, exponents
from keyss.core.gaussians import Gaussians

_GROUPS = (slice(0, 3), QUATS, slice(7, 8), slice(8, None))
_SHORT_BITS = 20
_SHORT = np.uint32((1 << _SHORT_BITS) - 1)
_ZEROS, _ZERO_FIELDS = np.uint32((1 << 12) - 1), 3
_EQUAL_HARMONICS = 2
_EXACT = 1e-6
_MANTISSA = np.uint32((1 << 23) - 1)


def identities(gaussians: Gaussians) -> Bytes:
    """[N, 16] one call of hashlib for each Gaussian."""
    rows = np.concatenate(
        [words_of(gaussians)[0], used_words(gaussians) & ~Layout.of(gaussians).mask], axis=1
    )
    hashes = b"".join(
        hashlib.blake2b(row.astype("<u4").tobytes(), digest_size=16, person=b"keyss/identity").digest()
        for row in rows
    )
    return np.frombuffer(hashes, np.uint8).reshape(-1, 16)


def read_low_bits(gaussians: Gaussians) -> Bytes:
    """[N, B]."""
    layout = Layout.of(gaussians)
    return _packed((used_words(gaussians) & layout.mask)[:, layout.columns], layout)


def written_words(gaussians: Gaussians, rows: npt.NDArray[np.int64], data: Bytes) -> Words:
    """[N, F] the fields after `write_low_bits`."""
    layout, used = Layout.of(gaussians), used_words(gaussians)
    mask = layout.mask
    if _sh_count(layout.sh_degree) % 2:  # 12 bits are a byte and a half
        mask[-1] &= ~np.uint32(15 << UNUSED_BITS)
    new = np.zeros((len(rows), used.shape[1]), np.uint32)
    new[:, layout.columns] = _unpacked(data, layout)
    used[rows] = used[rows] & ~mask | new & mask
    return used


def _sh_count(sh_degree: int) -> int:
    """Spherical harmonics above the constant ones, of three colours."""
    return 3 * ((sh_degree + 1) ** 2 - 1)


def _packed(low: Words, layout: Layout) -> Bytes:
    """[N, B] the bytes of the masked words [N, F'] of the fields in use."""
    low = low >> np.uint32(UNUSED_BITS)
    before = low.shape[1] - _sh_count(layout.sh_degree)
    sh = low[:, before:]
    if sh.shape[1] % 2:
        sh = np.concatenate([sh, np.zeros((len(sh), 1), np.uint32)], axis=1)
    first, second = sh[:, 0::2], sh[:, 1::2]  # two times 12 bits are three bytes
    packed = np.stack([first >> 4, (first & 15) << 4 | second >> 8, second & 255], axis=2)
    table = np.concatenate([low[:, :before], packed.reshape(len(low), -1)], axis=1)
    return table[:, : layout.width].astype(np.uint8)


def _unpacked(data: Bytes, layout: Layout) -> Words:
    """[N, F'] the words of bytes [N, B]: the inverse of `_packed`, zeros where a byte is missing."""
    count = _sh_count(layout.sh_degree)
    before = len(layout.columns) - count
    padded = np.zeros((len(data), -(-count // 2) * 3), np.uint32)
    padded[:, : data.shape[1] - before] = data[:, before:]
    a, b, c = padded[:, 0::3], padded[:, 1::3], padded[:, 2::3]
    sh = np.stack([a << 4 | b >> 4, (b & 15) << 8 | c], axis=2).reshape(len(data), -1)[:, :count]
    return np.concatenate([data[:, :before], sh], axis=1) << np.uint32(UNUSED_BITS)


def usable_carriers(gaussians: Gaussians) -> Flags:
    """[N]."""
    layout, used = Layout.of(gaussians), used_words(gaussians)
    usable = ~_occur_together(gaussians, layout)
    frequent, short = frequent_values(gaussians), _has_short_values(used, layout)
    usable &= _are_measured(used, layout, frequent, short) & ~near_equal(used, layout)
    if layout.quats:
        usable &= ~_have_unit_length(used)
    counts = [count_trailing_zeros(used[usable, group]) for group in _GROUPS]
    least = [least_exponent(count, GIVEN_AWAY / len(_GROUPS)) for count in counts]
    for group, limit in zip(_GROUPS, least, strict=True):
        if layout.quats or group != QUATS:
            values = used[:, group]
            usable &= ~((exponents(values) < limit) & (values & 1 == 0)).any(axis=1)
    return usable


def near_equal(used: Words, layout: Layout) -> Flags:
    """[N] whether two scales, two components of a quaternion or two channels of a colour are nearly equal.

    Or _EQUAL_HARMONICS pairs of one colour's harmonics, next to each other by size, equal. Decided by the
    bits that embedding leaves, which by chance are so in some 4 % of all Gaussians. `used`: [N, F] of
    `used_words`.
    """
    shifts = [int(mask).bit_length() for mask in layout.mask]
    high = ((used & np.uint32(0x7FFFFFFF)) >> np.array(shifts, np.uint32)).astype(np.int32)
    found = np.zeros(len(used), dtype=bool)
    together = [high[:, None, 0:3], high[:, GEOMETRY:].reshape(len(used), -1, 3)]
    if layout.quats:
        together.append(high[:, None, QUATS])
    for values in together:
        for a, b in combinations(range(values.shape[2]), 2):
            found |= (np.abs(values[:, :, a] - values[:, :, b]) <= 1).any(axis=1)
    harmonics = np.sort(high[:, GEOMETRY:].reshape(len(used), -1, 3), axis=1)
    found |= (np.diff(harmonics, axis=1) == 0).sum(axis=(1, 2)) >= _EQUAL_HARMONICS
    return found


def _has_short_values(used: Words, layout: Layout) -> bool:
    used = used[:, layout.columns]
    found = int((((used & _SHORT) == 0) & (exponents(used) > 0)).sum())
    expected = used.size / 2.0**_SHORT_BITS
    return bool(found > expected + 5 * (expected + 1) ** 0.5)


def _are_measured(used: Words, layout: Layout, frequent: list[Words], short: bool) -> Flags:
    """[N] whether no number in use is subnormal or frequent, and few have many zeros; if `short`, none is."""
    large = exponents(used)
    fine = (large > 0) & (large < 254)
    if short:
        fine &= (used & _SHORT) != 0
    for group, values in zip(_GROUPS, frequent, strict=True):
        fine[:, group] &= ~np.isin(used[:, group], values)
    zeros = ((used & _ZEROS) == 0)[:, layout.columns].sum(axis=1)
    measured: Flags = fine[:, layout.columns].all(axis=1) & (zeros < _ZERO_FIELDS)
    return measured


def _have_unit_length(used: Words) -> Flags:
    """[N] whether a quaternion has it, and whatever its low bits are could have it."""
    words = np.ascontiguousarray(used[:, QUATS])
    near = np.abs(coarse_lengths(words) - 1) < UNIT_TOLERANCE
    lengths = np.linalg.norm(np.where(near[:, None], words.view(np.float32).astype(np.float64), 0), axis=1)
    unit: Flags = near & (np.abs(lengths - 1) < _EXACT)
    return unit


def _occur_together(gaussians: Gaussians, layout: Layout) -> Flags:
    """[N] by the bits themselves, without a hash."""
    high = used_words(gaussians) & ~layout.mask & ~np.uint32(1)
    together = [np.arange(3)]
    if layout.quats:
        together.append(np.arange(3, 7))
    together += [np.arange(start, start + 6) for start in range(GEOMETRY, len(layout.mask) - 5, 6)]
    parts = [high[:, columns] for columns in together] + [identities(gaussians)[:, :8]]
    found = np.zeros(len(gaussians), dtype=bool)
    for part in parts:
        _, inverse, times = np.unique(part, axis=0, return_inverse=True, return_counts=True)
        found |= times[inverse.ravel()] > 1
    return found


def frequent_values(gaussians: Gaussians) -> list[Words]:
    """For each group of fields [V] the values that occur more often than is likely."""
    used = used_words(gaussians)
    found = []
    for group in _GROUPS:
        flat = np.sort(used[:, group], axis=None)
        more = _unlikely_copies(flat.size) - 1
        found.append(np.unique(flat[more:][flat[more:] == flat[: len(flat) - more]]))
    return found


def ranks(used: Words, layout: Layout) -> npt.NDArray[np.uint64]:
    """[N] 0 to 511: 256 for what may well be left alone, and less the larger the least harmonic is."""
    chosen = used[:, layout.columns]
    doubtful: Flags = near_equal(used, layout) | (exponents(chosen) == 0).any(axis=1)
    doubtful |= (chosen & _MANTISSA & ~layout.mask[layout.columns] & ~np.uint32(1) == 0).any(axis=1)
    if layout.quats:
        doubtful |= np.abs(coarse_lengths(used[:, QUATS]) - 1) < UNIT_TOLERANCE
    harmonics = used[:, GEOMETRY:] if used.shape[1] > GEOMETRY else chosen
    least = 255 - exponents(harmonics).min(axis=1).astype(np.uint64)
    found: npt.NDArray[np.uint64] = doubtful.astype(np.uint64) << np.uint64(8) | least
    return found
