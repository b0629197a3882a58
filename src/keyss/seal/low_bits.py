"""The low mantissa bits of a model's floats: where they are, whose can be replaced, and who they belong to.

The 12 low bits of the 23 of a mantissa are, in a trained model, uniformly random for everybody who does not
know how it was trained: replacing them changes a value by less than 0.05 %. Used are log scales, quaternions,
opacity logits and the spherical harmonics above the constant ones. Not positions: the least change swaps
Gaussians of nearly equal depth, and a swap can be seen (48 dB where everything else stays above 79 dB).
Not the constant colours: many keep the few digits they were initialised with.

What stays of a Gaussian, its position and the high bits, is its *identity*, by which it is known in any
order. Sign and exponent never change.
"""

from __future__ import annotations

import hashlib
from collections import Counter

import numpy as np
import numpy.typing as npt
import torch

from keyss.core.errors import InputError
from keyss.core.gaussians import Gaussians

BITS = 12
IDENTITY_BYTES = 16
_LOW = np.uint32((1 << BITS) - 1)

# A value is not random, but a short number or zero, when at least this many low bits of its mantissa are
# zero; by chance that happens to one value in a million.
_SHORT = np.uint32((1 << 20) - 1)
_ZERO_FIELDS = 3  # so many fields of one Gaussian with all low bits zero: by chance one in three million
_COPIES = 16  # a value that so many Gaussians share was not trained but given

_SAMPLE = 20_000
_LARGEST_RATIO = 2.0  # chi-square over degrees of freedom; 0.7 to 1.3 in trained models, above 50 in others

Words = npt.NDArray[np.uint32]
Bytes = npt.NDArray[np.uint8]


def field_count(sh_degree: int) -> int:
    """Floats of a Gaussian whose low bits are used: 8, and 3 per coefficient above the constant ones."""
    return 8 + 3 * ((sh_degree + 1) ** 2 - 1)


def bytes_per_gaussian(sh_degree: int) -> int:
    """Whole bytes that the low bits of one Gaussian hold: 79 at degree 3."""
    return field_count(sh_degree) * BITS // 8


def identities(gaussians: Gaussians) -> list[bytes]:
    """16 bytes for each Gaussian, public, of all that embedding leaves as it is."""
    rows = np.concatenate([_words(gaussians.means), _used(gaussians) & ~_LOW], axis=1)
    data, size = rows.astype("<u4").tobytes(), 4 * rows.shape[1]
    return [
        hashlib.blake2b(
            data[start : start + size], digest_size=IDENTITY_BYTES, person=b"keyss/identity"
        ).digest()
        for start in range(0, len(data), size)
    ]


def read_low_bits(gaussians: Gaussians) -> Bytes:
    """[N, B] the low bits of each Gaussian as `bytes_per_gaussian` bytes."""
    low = _used(gaussians) & _LOW
    if low.shape[1] % 2:
        low = np.concatenate([low, np.zeros((len(low), 1), np.uint32)], axis=1)
    first, second = low[:, 0::2], low[:, 1::2]  # two times 12 bits are three bytes
    packed = np.stack([first >> 4, (first & 15) << 4 | second >> 8, second & 255], axis=2)
    return packed.reshape(len(low), -1)[:, : bytes_per_gaussian(gaussians.sh_degree)].astype(np.uint8)


def write_low_bits(gaussians: Gaussians, rows: npt.NDArray[np.int64], data: Bytes) -> Gaussians:
    """The same Gaussians with other low bits [R, B] in the `rows` [R]; half a byte may stay as it is."""
    used = _used(gaussians)
    padded = np.zeros((len(data), -(-used.shape[1] // 2) * 3), np.uint32)
    padded[:, : data.shape[1]] = data
    a, b, c = padded[:, 0::3], padded[:, 1::3], padded[:, 2::3]
    low = np.stack([a << 4 | b >> 4, (b & 15) << 8 | c], axis=2).reshape(len(data), -1)[:, : used.shape[1]]
    if used.shape[1] * BITS % 8:  # the last half byte is not in use
        low[:, -1] |= used[rows, -1] & 15
    used[rows] = used[rows] & ~_LOW | low
    return _with_used(gaussians, used)


def is_random(gaussians: Gaussians) -> npt.NDArray[np.bool_]:
    """[N] whether the low bits of a Gaussian look like those of trained values, and can be replaced.

    Not so with zeros, integers and short fractions, subnormal numbers, values that many Gaussians share, and
    Gaussians that are there twice.
    """
    used = _used(gaussians)
    exponents = used >> 23 & 255
    good = ((used & _SHORT) != 0) & (exponents > 0) & (exponents < 254)
    for column in range(used.shape[1]):
        _, inverse, counts = np.unique(used[:, column], return_inverse=True, return_counts=True)
        good[:, column] &= counts[inverse] < _COPIES
    result: npt.NDArray[np.bool_] = good.all(axis=1) & (((used & _LOW) == 0).sum(axis=1) < _ZERO_FIELDS)
    names = identities(gaussians)
    times = Counter(names)
    result &= np.array([times[name] == 1 for name in names], dtype=bool)
    return result


def check_natural(gaussians: Gaussians, chosen: npt.NDArray[np.bool_]) -> None:
    """Raise InputError unless the low bits of the `chosen` Gaussians [N] are uniform in every field.

    Chi-square of the frequencies of two overlapping bytes, over at most 20,000 Gaussians.
    """
    rows = np.flatnonzero(chosen)
    rows = rows[:: max(1, len(rows) // _SAMPLE)]
    used = _used(gaussians)[rows]
    for shift in (0, BITS - 8):
        for column in range(used.shape[1]):
            counts = np.bincount(used[:, column] >> shift & 255, minlength=256)
            expected = len(rows) / 256
            ratio = float(((counts - expected) ** 2).sum() / expected / 255)
            if ratio > _LARGEST_RATIO:
                raise InputError(
                    f"the low bits of {_field_name(column)} are not random in this model (chi-square "
                    f"{ratio:.1f} per degree of freedom, 1 expected), so that nothing can be hidden in them: "
                    "it was quantised, scaled or moved after its training; --sidecar needs no low bits"
                )


def _field_name(column: int) -> str:
    groups = ((3, "scale_"), (4, "rot_"), (1, "opacity"))
    for size, name in groups:
        if column < size:
            return name if size == 1 else f"{name}{column}"
        column -= size
    return "f_rest"


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
    rest = values[:, 8:].reshape(len(values), -1, 3)
    return Gaussians(
        means=gaussians.means,
        quats=values[:, 3:7].contiguous(),
        log_scales=values[:, :3].contiguous(),
        opacity_logits=values[:, 7].contiguous(),
        sh=torch.cat([gaussians.sh[:, :1], rest], dim=1),
    )
