"""A model as one string of bytes.

    number of Gaussians (4 bytes), SH degree (1), centres (20), steps (24), all numbers (see `entropy`)

Gaussians are sorted along a Z-order curve. Every number is divided by a step and rounded, so outliers cost
more bits and no precision. Colours become brightness and two differences. Several quaternions describe the
same ellipsoid; the one with the largest w is stored, without w. Extreme numbers, which occlude everything or
are invisible, are clamped.

Errors in quaternions and harmonics are more visible in Gaussians that cover more of an image. Their steps
shrink by a quarter of an octave for each octave of area x opacity^2 above the median. (Equal errors in an
image need half an octave, but small Gaussians are seen from nearer; a quarter measured best.) Encoder and
decoder compute the steps from scales and opacity.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass, fields

import numpy as np
import torch

from keyss.core.arrays import Doubles, Integers, doubles
from keyss.core.errors import InputError
from keyss.core.gaussians import MAX_COORDINATE, MAX_LOG_SCALE, OPPONENT, Gaussians
from keyss.files.formats.common import in_morton_order, with_largest_w
from keyss.kernels.parallel import in_blocks
from keyss.methods.codec import entropy
from keyss.methods.codec.entropy import Table

_ALWAYS = 1 << 16  # number of Gaussians that a payload of any size may declare
_MIN_BYTES = 2  # minimum bytes per Gaussian of a larger model
_HEAD = struct.Struct("<IB5f6f")
_POSITION_STEP = 0.03  # relative to the median size of Gaussians
_DIFFERENCES = np.array([1.0, 1.5, 1.5])  # steps of brightness and differences of constant colours
_PER_OCTAVE = 0.5 / math.log(2)  # half octaves of the step
_FINER = 6  # maximum change of a step, in half octaves
_MAX_STEP = 1e6
_BLOCK = 1 << 14  # Gaussians per block
_MAX_LOGIT = 16.0  # beyond it the float32 sigmoid is exactly 0 or 1
_LEAST_W = 1 / 16  # minimum w^2
# `shares` and `groups` of `entropy.encode` for the columns x, y, z, log scales, opacity, colours, quaternion.
# Harmonics have two more groups and no prediction.
_SHARES = (8, 8, 8, 2, 2, 2, 2, 6, 6, 6, 0, 0, 0)
_GROUPS = (0, 0, 0, 1, 1, 1, 2, 3, 4, 4, 5, 5, 5)


@dataclass(frozen=True)
class Precision:
    """Quantisation steps of the attributes, rounded to float32."""

    means: float
    log_scales: float = 0.04
    opacity_logits: float = 0.1
    colours: float = 0.024
    quats: float = 0.013
    harmonics: float = 0.06

    @staticmethod
    def usual(model: Gaussians) -> Precision:
        """About 46 dB."""
        size = float(model.log_scales.sort(dim=1).values[:, 1].median())
        return Precision(_POSITION_STEP * math.exp(min(max(size, -20), 15)))

    def finer(self, octaves: float) -> Precision:
        """Divide all steps by 2^octaves."""
        return Precision(*(step * 2**-octaves for step in self.steps))

    @property
    def steps(self) -> list[float]:
        """The steps as stored: float32, clamped."""
        steps = np.array([getattr(self, field.name) for field in fields(self)], np.float32)
        return [float(each) for each in steps.clip(1e-12, _MAX_STEP)]


def encode(model: Gaussians, precision: Precision | None = None) -> bytes:
    """Encode `model`, by default with the usual precision."""
    model = in_morton_order(model)
    steps = (precision or Precision.usual(model)).steps
    numbers = _uniform_columns(model)
    parts = (0, 1, 2, slice(3, 6), 6)  # x, y, z, log scales, opacity logits
    centres = [float(np.float32(np.median(numbers[:, part]))) for part in parts]
    codes = np.empty((len(model), 10 + model.sh[0].numel()), np.int32)
    codes[:, :10] = _round((numbers - _origin(centres)) / _uniform_steps(steps))
    finer = _refinement(*_uniform_numbers(codes[:, :10], centres, steps)[1:3])

    def fill(start: int, stop: int) -> None:
        own, finest = codes[start:stop], finer[start:stop]
        quats = with_largest_w(doubles(model.quats[start:stop]))[:, 1:]
        harmonics = (doubles(model.sh[start:stop, 1:]) @ OPPONENT.T).reshape(len(own), -1)
        own[:, 10:13] = _round(quats / _steps(steps[4], finest))
        own[:, 13:] = _round(harmonics / _steps(steps[5], finest))

    in_blocks(fill, len(model), _BLOCK)
    head = _HEAD.pack(len(model), model.sh_degree, *centres, *steps)
    return head + entropy.encode(codes, *_columns(model.sh_degree))


def decode(data: bytes, model_size: int | None = None) -> Gaussians:
    """Invert `encode`; `model_size`: Gaussians of the stego model. Raises InputError for damage.

    Memory is bounded: above 2^16 Gaussians, each takes at least 2 bytes of `data`, and `model_size` is the
    maximum.
    """
    if len(data) < _HEAD.size:
        raise InputError("the hidden secret is damaged: it is too short")
    count, sh_degree, *numbers = _HEAD.unpack_from(data)
    centres, steps = numbers[:5], numbers[5:]
    bounded = all(abs(each) < 1e30 for each in centres) and all(0 < each <= _MAX_STEP for each in steps)
    if not (count > 0 and sh_degree <= 3 and bounded):
        raise InputError(
            f"the hidden secret is damaged: it declares {count:,} Gaussians of SH degree {sh_degree}"
        )
    largest = len(data) // _MIN_BYTES
    if count > max(_ALWAYS, largest if model_size is None else min(largest, model_size)):
        held_by = f"{len(data):,} bytes" + ("" if model_size is None else f" in {model_size:,} Gaussians")
        raise InputError(
            f"the hidden secret is damaged: it declares {count:,} Gaussians, more than {held_by} can hold"
        )
    codes = entropy.decode(data[_HEAD.size :], count, *_columns(sh_degree))
    means, log_scales, logits, colours = _uniform_numbers(codes[:, :10], centres, steps)
    finer = _refinement(log_scales, logits)
    quats, sh = np.empty((count, 4), np.float32), np.empty((count, (sh_degree + 1) ** 2, 3), np.float32)

    def fill(start: int, stop: int) -> None:
        own, finest = codes[start:stop], finer[start:stop]
        x, y, z = (own[:, 10:13] * _steps(steps[4], finest)).T
        w = np.sqrt(np.maximum(1 - (x * x + y * y + z * z), _LEAST_W))
        quats[start:stop] = np.stack([w, x, y, z], axis=1)
        parts = np.concatenate([colours[start:stop], own[:, 13:] * _steps(steps[5], finest)], axis=1)
        sh[start:stop] = _from_opponents(parts.reshape(len(own), -1, 3))

    in_blocks(fill, count, _BLOCK)
    tensors = (means.astype(np.float32), quats, log_scales.astype(np.float32), logits.astype(np.float32), sh)
    return Gaussians(*map(torch.from_numpy, tensors))


def _columns(sh_degree: int) -> tuple[Integers, Integers]:
    """`shares` and `groups` of all columns."""
    others = (sh_degree + 1) ** 2 - 1
    return np.array([*_SHARES, *[0, 0, 0] * others]), np.array([*_GROUPS, *[6, 7, 7] * others])


def _round(numbers: Doubles) -> Doubles:
    bounded: Doubles = np.nan_to_num(numbers).clip(-entropy.MAX_NUMBER, entropy.MAX_NUMBER)
    return np.rint(bounded)


def _uniform_columns(model: Gaussians) -> Doubles:
    """Means, log scales, opacity logits and constant colours [N, 10], clamped: columns of uniform steps.

    Rasterizers skip Gaussians whose numbers overflow. Clamped numbers would make these visible, so they
    become transparent.
    """
    logits = torch.where(model.overflow, -_MAX_LOGIT, model.opacity_logits.clamp(-_MAX_LOGIT, _MAX_LOGIT))
    means = model.means.clamp(-MAX_COORDINATE, MAX_COORDINATE)
    log_scales = model.log_scales.clamp(-MAX_LOG_SCALE, MAX_LOG_SCALE)
    parts = map(doubles, (means, log_scales, logits[:, None]))
    return np.concatenate([*parts, doubles(model.sh[:, 0]) @ OPPONENT.T], axis=1)


def _origin(centres: list[float]) -> Doubles:
    """The numbers [10] to subtract from the `_uniform_columns`."""
    x, y, z, scales, logit = centres
    return np.array([x, y, z, scales, scales, scales, logit, 0, 0, 0])


def _uniform_steps(steps: list[float]) -> Doubles:
    """Steps [10] of the columns whose step is the same for all Gaussians."""
    means, log_scales, opacity, colours, *_ = steps
    return np.array([*[means] * 3, *[log_scales] * 3, opacity, *colours * _DIFFERENCES])


def _uniform_numbers(codes: Table, centres: list[float], steps: list[float]) -> list[Doubles]:
    """Means [N, 3], log scales [N, 3], opacity logits [N] and colours [N, 3] from codes [N, 10]."""
    numbers = codes * _uniform_steps(steps) + _origin(centres)
    return [numbers[:, :3], numbers[:, 3:6], numbers[:, 6], numbers[:, 7:]]


def _from_opponents(parts: Doubles) -> Doubles:
    """Colours [N, K, 3] from brightness and two differences, in a fixed order of operations."""
    bright, first, second = (parts[:, :, row, None] * OPPONENT[row] for row in range(3))
    colours: Doubles = bright + first + second
    return colours


def _refinement(log_scales: Doubles, logits: Doubles) -> Integers:
    """Half octaves [N] by which the other steps of each Gaussian are finer than the median Gaussian's."""
    scales = np.sort(log_scales, axis=1)
    weight = scales[:, 2] + scales[:, 1] + 2 * np.minimum(logits, 0)  # log(opacity) is about min(logit, 0)
    median = np.sort(weight)[(len(weight) - 1) // 2]
    found: Integers = np.floor((weight - median) * _PER_OCTAVE + 0.5).astype(np.int64)
    return found.clip(-_FINER, _FINER)


def _steps(step: float, finer: Integers) -> Doubles:
    """Steps [N, 1]: `step` times a power of two, and the square root of two for odd `finer`."""
    steps: Doubles = step * np.where(finer % 2, math.sqrt(2), 1.0) * 2.0 ** -((finer + 1) // 2)
    return steps[:, None]
