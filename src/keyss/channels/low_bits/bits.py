"""The low mantissa bits of a model's floats: where they are, which can be replaced, and whose they are.

In a trained model the low bits are uniformly random for everybody who does not know how it was trained.
Used are 8 bits of log scales, quaternions and opacity logits, and 12 bits of the spherical harmonics above
the constant ones, of the 23 bits of a mantissa. The last bit of all is left alone: rounding to even makes it
a zero more often than a one, by a third of a percent in spherical harmonics, which a classifier notices.
Positions are not used: the least change can swap two Gaussians of nearly equal depth, and a swap is visible
(48 dB in a view where everything else stays above 79 dB). Nor are constant colours, of which many keep the
few digits that they were initialised with.

What stays of a Gaussian, its position and the high bits, is its *identity*, by which it is known in any
order. Sign and exponent never change. All functions work through a model in blocks, so that memory beside
the model itself stays small.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from keyss.core.errors import InputError
from keyss.core.gaussians import Gaussians

IDENTITY_BYTES = 16
_FIELDS = ("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3", "opacity")
_GEOMETRY = len(_FIELDS)  # fields of a Gaussian before the spherical harmonics
_GEOMETRY_BITS, _SH_BITS = 8, 12
_UNUSED_BITS = 1  # below them
_GROUPS = (slice(0, 3), slice(3, 7), slice(7, 8), slice(8, None))  # scales, quaternions, opacity, harmonics

# A value is not random, but a short number or zero, when at least this many low bits of its mantissa are
# zero; by chance that happens to one value in a million.
_SHORT = np.uint32((1 << 20) - 1)
# Nor is a Gaussian, when so many of its values have so many zeros; by chance one in three million is that.
_ZEROS, _ZERO_FIELDS = np.uint32((1 << 12) - 1), 3

_BLOCK = 1 << 16  # Gaussians at a time
_SAMPLE = 20_000
LEAST_USABLE = 0.5  # share of the Gaussians of a cover
_SHIFTS = (_UNUSED_BITS, _UNUSED_BITS + _SH_BITS - 8)  # two overlapping bytes
_LARGEST_RATIO = 2.0  # chi-square over degrees of freedom; 0.7 to 1.3 in trained models, above 50 in others

Words = npt.NDArray[np.uint32]
Bytes = npt.NDArray[np.uint8]
Flags = npt.NDArray[np.bool_]


def bytes_per_gaussian(sh_degree: int) -> int:
    """Whole bytes that the low bits of one Gaussian hold: 8, 21, 44 and 75 at degrees 0 to 3."""
    return _GEOMETRY + _sh_count(sh_degree) * 3 // 2


def identities(gaussians: Gaussians) -> Bytes:
    """[N, 16] for each Gaussian a public hash (BLAKE2b) of all that embedding leaves as it is."""
    hashes = bytearray()
    for part in _blocks(gaussians):
        rows = np.concatenate([_words(part.means), _used(part) & ~_mask(part)], axis=1)
        data, size = rows.astype("<u4").tobytes(), 4 * rows.shape[1]
        for start in range(0, len(data), size):
            row = data[start : start + size]
            hashes += hashlib.blake2b(row, digest_size=IDENTITY_BYTES, person=b"keyss/identity").digest()
    return np.frombuffer(hashes, np.uint8).reshape(-1, IDENTITY_BYTES)


def read_low_bits(gaussians: Gaussians) -> Bytes:
    """[N, B] the low bits of each Gaussian as `bytes_per_gaussian` bytes."""
    width = bytes_per_gaussian(gaussians.sh_degree)
    return np.concatenate([_packed(_used(part) & _mask(part), width) for part in _blocks(gaussians)])


def write_low_bits(gaussians: Gaussians, rows: npt.NDArray[np.int64], data: Bytes) -> Gaussians:
    """The same Gaussians with other low bits [R, B] in the `rows` [R], which are different ones.

    Where a Gaussian's bits are no whole number of bytes, the last half byte stays as it is.
    """
    mask = _mask(gaussians)
    if len(mask[_GEOMETRY:]) % 2:  # 12 bits are a byte and a half
        mask[-1] &= ~np.uint32(15 << _UNUSED_BITS)
    order = np.argsort(rows)
    ascending = rows[order]
    parts = []
    for start, part in zip(range(0, len(gaussians), _BLOCK), _blocks(gaussians), strict=True):
        first, last = np.searchsorted(ascending, (start, start + len(part)))
        own, used = ascending[first:last] - start, _used(part)
        used[own] = used[own] & ~mask | _unpacked(data[order[first:last]], len(mask)) & mask
        parts.append(_with_used(part, used))
    return Gaussians.cat(parts)


def usable_carriers(gaussians: Gaussians) -> Flags:
    """[N] which Gaussians have low bits that look like those of trained values, and can be replaced.

    Left alone are zeros, integers and short fractions, subnormal numbers, values that occur too often (after
    a few steps of training many are the same small multiple of the learning rate), Gaussians that occur
    twice, and near-equal components. A Gaussian whose bits are random must hardly ever be left alone: what is
    left stays, embedding makes more of the same kind by chance, and twice as many as expected would be seen.
    """
    good, zeros = np.ones(len(gaussians), bool), np.zeros(len(gaussians), np.int64)
    frequent = _frequent_values(gaussians)
    for start, part in zip(range(0, len(gaussians), _BLOCK), _blocks(gaussians), strict=True):
        used, rows = _used(part), slice(start, start + _BLOCK)
        exponents = used >> 23 & 255
        fine = ((used & _SHORT) != 0) & (exponents > 0) & (exponents < 254)
        for group, values in zip(_GROUPS, frequent, strict=True):
            fine[:, group] &= ~np.isin(used[:, group], values)
        good[rows] = fine.all(axis=1) & ~_has_near_equal_components(used, _mask(part))
        zeros[rows] = ((used & _ZEROS) == 0).sum(axis=1)
    _, inverse, times = np.unique(
        identities(gaussians)[:, :8].copy().view("<u8")[:, 0], return_inverse=True, return_counts=True
    )
    usable: Flags = good & (zeros < _ZERO_FIELDS) & (times[inverse] == 1)
    return usable


def check_usable(gaussians: Gaussians, usable: Flags) -> None:
    """Raise InputError unless half of the Gaussians are `usable` [N], with uniform low bits in every field.

    Uniform: chi-square of the frequencies of two overlapping bytes, over at most 20,000 Gaussians.
    """
    if not len(usable) or usable.mean() < LEAST_USABLE:
        share = usable.mean() if len(usable) else 0.0
        raise InputError(
            f"only {share:.0%} of the Gaussians have random low bits; the others hold short or repeated "
            "values: the model was quantised or hardly trained, and what is put there could be seen"
        )
    rows = np.flatnonzero(usable)
    rows = rows[:: max(1, len(rows) // _SAMPLE)]
    used = _used(gaussians[torch.from_numpy(rows)])
    for shift in _SHIFTS:
        for column in range(used.shape[1]):
            ratio = _chi_square(used[:, column] >> shift & 255)
            if ratio > _LARGEST_RATIO:
                name = _FIELDS[column] if column < _GEOMETRY else "f_rest"
                raise InputError(
                    f"the low bits of {name} are not random in this model (chi-square "
                    f"{ratio:.1f} per degree of freedom, 1 expected), so that nothing can be hidden in them: "
                    "it was quantised, scaled or moved after its training"
                )


def is_uniform(values: npt.NDArray[np.float32]) -> bool:
    """The same test for one property [N]."""
    words = np.ascontiguousarray(values[:: max(1, len(values) // _SAMPLE)]).view(np.uint32)
    return all(_chi_square(words >> shift & 255) <= _LARGEST_RATIO for shift in _SHIFTS)


def _chi_square(bytes_: npt.NDArray[np.integer[Any]]) -> float:
    """Per degree of freedom, of the frequencies of numbers below 256."""
    counts = np.bincount(bytes_, minlength=256)
    expected = len(bytes_) / 256
    return float(((counts - expected) ** 2).sum() / expected / 255)


def _sh_count(sh_degree: int) -> int:
    """Spherical harmonics above the constant ones, of three colours."""
    return 3 * ((sh_degree + 1) ** 2 - 1)


def _mask(gaussians: Gaussians) -> Words:
    """[F] the bits in use of every field."""
    bits = [_GEOMETRY_BITS] * _GEOMETRY + [_SH_BITS] * _sh_count(gaussians.sh_degree)
    return np.array([((1 << count) - 1) << _UNUSED_BITS for count in bits], np.uint32)


def _blocks(gaussians: Gaussians) -> Iterator[Gaussians]:
    """The model in parts; one that is empty for a model that is."""
    return (gaussians[start : start + _BLOCK] for start in range(0, max(len(gaussians), 1), _BLOCK))


def _packed(low: Words, width: int) -> Bytes:
    """[N, width] the bytes of masked words [N, F]."""
    low = low >> np.uint32(_UNUSED_BITS)
    sh = low[:, _GEOMETRY:]
    if sh.shape[1] % 2:
        sh = np.concatenate([sh, np.zeros((len(sh), 1), np.uint32)], axis=1)
    first, second = sh[:, 0::2], sh[:, 1::2]  # two times 12 bits are three bytes
    packed = np.stack([first >> 4, (first & 15) << 4 | second >> 8, second & 255], axis=2)
    table = np.concatenate([low[:, :_GEOMETRY], packed.reshape(len(low), -1)], axis=1)
    return table[:, :width].astype(np.uint8)


def _unpacked(data: Bytes, fields: int) -> Words:
    """[N, fields] the words of bytes [N, width]: the inverse of `_packed`, zeros where a byte is missing."""
    count = fields - _GEOMETRY
    padded = np.zeros((len(data), -(-count // 2) * 3), np.uint32)
    padded[:, : data.shape[1] - _GEOMETRY] = data[:, _GEOMETRY:]
    a, b, c = padded[:, 0::3], padded[:, 1::3], padded[:, 2::3]
    sh = np.stack([a << 4 | b >> 4, (b & 15) << 8 | c], axis=2).reshape(len(data), -1)[:, :count]
    return np.concatenate([data[:, :_GEOMETRY], sh], axis=1) << np.uint32(_UNUSED_BITS)


def _has_near_equal_components(used: Words, mask: Words) -> Flags:
    """[N] whether two scales, two components of a quaternion or two channels of a colour are nearly equal.

    Grey Gaussians have that, and round ones: their low bits are not independent. Decided by the bits that
    embedding leaves, which by chance are the same, or neighbours, in some 3 % of all Gaussians.
    """
    shifts = [int(bits).bit_length() for bits in mask]
    high = ((used & np.uint32(0x7FFFFFFF)) >> np.array(shifts, np.uint32)).astype(np.int32)
    found = np.zeros(len(used), dtype=bool)
    for together in (high[:, None, 0:3], high[:, None, 3:7], high[:, _GEOMETRY:].reshape(len(used), -1, 3)):
        found |= (np.diff(np.sort(together, axis=2), axis=2) <= 1).any(axis=(1, 2))
    return found


def _frequent_values(gaussians: Gaussians) -> list[Words]:
    """For each group of fields [V] the values that occur more often than is likely."""
    used = _used(gaussians)
    found = []
    for group in _GROUPS:
        flat = np.sort(used[:, group], axis=None)
        more = _unlikely_copies(flat.size) - 1
        found.append(np.unique(flat[more:][flat[more:] == flat[: len(flat) - more]]))
    return found


def _unlikely_copies(count: int) -> int:
    """The least c from 3 on so that sets of c equal ones are rare among `count` values: 3 up to a million.

    For 2^26 equally likely values there would be count^c / c! / 2^(26 (c - 1)) such sets, here at most 30.
    """
    copies = 3
    while count**copies / math.factorial(copies) > 30 * 2 ** (26 * (copies - 1)):
        copies += 1
    return copies


def _words(values: torch.Tensor) -> Words:
    flat = values.detach().to("cpu", torch.float32).reshape(len(values), -1).contiguous()
    return flat.numpy().view(np.uint32)


def _used(gaussians: Gaussians) -> Words:
    """[N, F] bit patterns of the fields in use; a copy."""
    fields = (gaussians.log_scales, gaussians.quats, gaussians.opacity_logits, gaussians.sh[:, 1:])
    return np.concatenate([_words(values) for values in fields], axis=1)


def _with_used(gaussians: Gaussians, used: Words) -> Gaussians:
    values = torch.from_numpy(used.view(np.float32)).to(gaussians.device)
    log_scales, quats, opacity_logits, rest = values.split((3, 4, 1, values.shape[1] - _GEOMETRY), dim=1)
    sh = torch.cat([gaussians.sh[:, :1], rest.reshape(len(values), -1, 3)], dim=1)
    opacity_logits = opacity_logits[:, 0].contiguous()
    return Gaussians(gaussians.means, quats.contiguous(), log_scales.contiguous(), opacity_logits, sh)
