"""The low mantissa bits of a model's floats: where they are, whose can be replaced, and who they belong to.

In a trained model the low bits are uniformly random for everybody who does not know how it was trained.
Used are 8 bits of log scales, quaternions and opacity logits, and 12 bits of the spherical harmonics above
the constant ones, of the 23 bits of a mantissa and without the last one: rounding to even makes that one
a zero more often than a one, by a third of a percent in spherical harmonics, which a classifier notices.
Not used are positions, for the least change swaps Gaussians of nearly equal depth and a swap can be seen
(48 dB in a view where everything else stays above 79 dB), and constant colours, of which many keep the few
digits that they were initialised with.

What stays of a Gaussian, its position and the high bits, is its *identity*, by which it is known in any
order. Sign and exponent never change.
"""

from __future__ import annotations

import hashlib
import math
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from keyss.core.errors import InputError
from keyss.core.gaussians import Gaussians

IDENTITY_BYTES = 16
_GEOMETRY = 8  # fields of a Gaussian before the spherical harmonics
_GEOMETRY_BITS, _SH_BITS = 8, 12
_UNUSED_BITS = 1  # below them
_GROUPS = (slice(0, 3), slice(3, 7), slice(7, 8), slice(8, None))  # scales, quaternions, opacity, harmonics

# A value is not random, but a short number or zero, when at least this many low bits of its mantissa are
# zero; by chance that happens to one value in a million.
_SHORT = np.uint32((1 << 20) - 1)
# Nor is a Gaussian, when so many of its values have so many zeros; by chance one in three million is that.
_ZEROS, _ZERO_FIELDS = np.uint32((1 << 12) - 1), 3

_CHUNK = 1 << 16
_SAMPLE = 20_000
_SHIFTS = (_UNUSED_BITS, _UNUSED_BITS + _SH_BITS - 8)  # two overlapping bytes
_LARGEST_RATIO = 2.0  # chi-square over degrees of freedom; 0.7 to 1.3 in trained models, above 50 in others

Words = npt.NDArray[np.uint32]
Bytes = npt.NDArray[np.uint8]


def bytes_per_gaussian(sh_degree: int) -> int:
    """Whole bytes that the low bits of one Gaussian hold: 8, 21, 44 and 75 at degrees 0 to 3."""
    return _GEOMETRY + _sh_count(sh_degree) * 3 // 2


def identities(gaussians: Gaussians) -> list[bytes]:
    """16 bytes for each Gaussian, public, of all that embedding leaves as it is."""
    rows = np.concatenate([_words(gaussians.means), _used(gaussians) & ~_mask(gaussians)], axis=1)
    data, size = rows.astype("<u4").tobytes(), 4 * rows.shape[1]
    return [
        hashlib.blake2b(
            data[start : start + size], digest_size=IDENTITY_BYTES, person=b"keyss/identity"
        ).digest()
        for start in range(0, len(data), size)
    ]


def read_low_bits(gaussians: Gaussians) -> Bytes:
    """[N, B] the low bits of each Gaussian as `bytes_per_gaussian` bytes."""
    low = (_used(gaussians) & _mask(gaussians)) >> _UNUSED_BITS
    sh = low[:, _GEOMETRY:]
    if sh.shape[1] % 2:
        sh = np.concatenate([sh, np.zeros((len(sh), 1), np.uint32)], axis=1)
    first, second = sh[:, 0::2], sh[:, 1::2]  # two times 12 bits are three bytes
    packed = np.stack([first >> 4, (first & 15) << 4 | second >> 8, second & 255], axis=2)
    table = np.concatenate([low[:, :_GEOMETRY], packed.reshape(len(low), -1)], axis=1)
    return table[:, : bytes_per_gaussian(gaussians.sh_degree)].astype(np.uint8)


def write_low_bits(gaussians: Gaussians, rows: npt.NDArray[np.int64], data: Bytes) -> Gaussians:
    """The same Gaussians with other low bits [R, B] in the `rows` [R]; half a byte may stay as it is."""
    used, mask = _used(gaussians), _mask(gaussians)
    count = used.shape[1] - _GEOMETRY
    padded = np.zeros((len(data), -(-count // 2) * 3), np.uint32)
    padded[:, : data.shape[1] - _GEOMETRY] = data[:, _GEOMETRY:]
    a, b, c = padded[:, 0::3], padded[:, 1::3], padded[:, 2::3]
    sh = np.stack([a << 4 | b >> 4, (b & 15) << 8 | c], axis=2).reshape(len(data), -1)[:, :count]
    low = np.concatenate([data[:, :_GEOMETRY], sh], axis=1) << np.uint32(_UNUSED_BITS)
    if count % 2:  # 12 bits are a byte and a half: the last half stays
        mask = mask.copy()
        mask[-1] &= ~np.uint32(15 << _UNUSED_BITS)
    used[rows] = used[rows] & ~mask | low & mask
    return _with_used(gaussians, used)


def is_random(gaussians: Gaussians) -> npt.NDArray[np.bool_]:
    """[N] whether the low bits of a Gaussian look like those of trained values, and can be replaced.

    Not so with zeros, integers and short fractions, subnormal numbers, values that are there too often (after
    a few steps of training many are the same small multiple of the learning rate), Gaussians that are there
    twice, and those with twins (see `_has_twins`). A test that looks at the low bits must exclude hardly
    anything that is random: what is excluded stays, the same comes up among the new low bits, and twice as
    much of it as by chance would be a tell.
    """
    used = _used(gaussians)
    good = np.ones(len(used), bool)
    zeros = np.zeros(len(used), np.int64)
    frequent, mask = [_frequent(used[:, group]) for group in _GROUPS], _mask(gaussians)
    for start in range(0, len(used), _CHUNK):  # some at a time: models may have millions of Gaussians
        part = used[start : start + _CHUNK]
        exponents = part >> 23 & 255
        fine = ((part & _SHORT) != 0) & (exponents > 0) & (exponents < 254)
        for group, values in zip(_GROUPS, frequent, strict=True):
            if len(values):
                place = np.searchsorted(values, part[:, group]).clip(max=len(values) - 1)
                fine[:, group] &= values[place] != part[:, group]
        good[start : start + _CHUNK] = fine.all(axis=1) & ~_has_twins(part, mask)
        zeros[start : start + _CHUNK] = ((part & _ZEROS) == 0).sum(axis=1)
    del used
    names = (
        name
        for start in range(0, len(good), _CHUNK)
        for name in identities(gaussians[start : start + _CHUNK])
    )
    _, inverse, times = np.unique(
        np.fromiter((int.from_bytes(name[:8], "little") for name in names), np.uint64, len(good)),
        return_inverse=True,
        return_counts=True,
    )
    result: npt.NDArray[np.bool_] = good & (zeros < _ZERO_FIELDS) & (times[inverse] == 1)
    return result


def _has_twins(used: Words, mask: Words) -> npt.NDArray[np.bool_]:
    """[N] whether two scales, two components of a quaternion or two channels of a colour are nearly equal.

    Grey Gaussians have that, and round ones: their low bits are not independent. Decided by the bits that
    embedding leaves, which by chance are the same, or neighbours, in some 3 % of all Gaussians.
    """
    shifts = [int(bits).bit_length() for bits in mask]
    high = ((used & np.uint32(0x7FFFFFFF)) >> np.array(shifts, np.uint32)).astype(np.int32)
    twins = np.zeros(len(used), dtype=bool)
    for together in (high[:, None, 0:3], high[:, None, 3:7], high[:, _GEOMETRY:].reshape(len(used), -1, 3)):
        twins |= (np.diff(np.sort(together, axis=2), axis=2) <= 1).any(axis=(1, 2))
    return twins


def check_natural(gaussians: Gaussians, chosen: npt.NDArray[np.bool_]) -> None:
    """Raise InputError unless the low bits of the `chosen` Gaussians [N] are uniform in every field.

    Chi-square of the frequencies of two overlapping bytes, over at most 20,000 Gaussians.
    """
    rows = np.flatnonzero(chosen)
    rows = rows[:: max(1, len(rows) // _SAMPLE)]
    used = _used(gaussians)[rows]
    for shift in _SHIFTS:
        for column in range(used.shape[1]):
            ratio = _chi_square(used[:, column] >> shift & 255)
            if ratio > _LARGEST_RATIO:
                raise InputError(
                    f"the low bits of {_field_name(column)} are not random in this model (chi-square "
                    f"{ratio:.1f} per degree of freedom, 1 expected), so that nothing can be hidden in them: "
                    "it was quantised, scaled or moved after its training; --sidecar needs no low bits"
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


def _field_name(column: int) -> str:
    groups = ((3, "scale_"), (4, "rot_"), (1, "opacity"))
    for size, name in groups:
        if column < size:
            return name if size == 1 else f"{name}{column}"
        column -= size
    return "f_rest"


def _sh_count(sh_degree: int) -> int:
    """Spherical harmonics above the constant ones, of three colours."""
    return 3 * ((sh_degree + 1) ** 2 - 1)


def _mask(gaussians: Gaussians) -> Words:
    """[F] the bits in use of every field."""
    bits = [_GEOMETRY_BITS] * _GEOMETRY + [_SH_BITS] * _sh_count(gaussians.sh_degree)
    return np.array([((1 << count) - 1) << _UNUSED_BITS for count in bits], np.uint32)


def _frequent(values: Words) -> Words:
    """[V] the values that occur more often than is likely."""
    flat = np.sort(values, axis=None)
    more = _unlikely_copies(flat.size) - 1
    return np.unique(flat[more:][flat[more:] == flat[: len(flat) - more]])


def _unlikely_copies(count: int) -> int:
    """The least c from 3 on so that sets of c equal ones are rare among `count` values: 3 up to a million.

    For 2^26 equally likely values there would be count^c / c! / 2^(26 (c - 1)) such sets, here at most 30.
    """
    copies = 3
    while copies * math.log(max(count, 1)) - math.lgamma(copies + 1) > math.log(
        30 * 2.0 ** (26 * (copies - 1))
    ):
        copies += 1
    return copies


def _words(values: torch.Tensor) -> Words:
    flat = values.detach().to("cpu", torch.float32).reshape(len(values), -1).contiguous()
    return flat.numpy().view(np.uint32)


def _used(gaussians: Gaussians) -> Words:
    """[N, F] bit patterns of the fields in use; a copy."""
    return np.concatenate(
        [
            _words(gaussians.log_scales),
            _words(gaussians.quats),
            _words(gaussians.opacity_logits),
            _words(gaussians.sh[:, 1:]),
        ],
        axis=1,
    )


def _with_used(gaussians: Gaussians, used: Words) -> Gaussians:
    values = torch.from_numpy(used.view(np.float32)).to(gaussians.device)
    rest = values[:, _GEOMETRY:].reshape(len(values), -1, 3)
    return Gaussians(
        means=gaussians.means,
        quats=values[:, 3:7].contiguous(),
        log_scales=values[:, :3].contiguous(),
        opacity_logits=values[:, 7].contiguous(),
        sh=torch.cat([gaussians.sh[:, :1], rest], dim=1),
    )
