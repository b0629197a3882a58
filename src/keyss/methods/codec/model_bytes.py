"""A model as one string of bytes.

    number of Gaussians (4 bytes), SH degree (1), centres (20), steps (24), typical weight (4),
    bytes of each block (4), blocks (see `entropy`)

Gaussians are sorted along a Z-order curve; BLOCK of them make a block, which is coded by itself, so that
threads share the work. Every number is divided by a step and rounded, so outliers cost more bits and no
precision. Colours become brightness and two differences. Several quaternions describe the same ellipsoid; the
one with the largest w is stored, without w. Extreme numbers, which occlude everything or are invisible, are
clamped.

Errors in quaternions and harmonics are more visible in Gaussians that cover more of an image. Their steps
shrink by a quarter of an octave for each octave of area x opacity^2, their *weight*, above the median.
(Equal errors in an image need half an octave, but small Gaussians are seen from nearer; a quarter measured
best.) Encoder and decoder compute the steps from scales and opacity.

Arithmetic is in a fixed order of single operations, so that all processors give the same bytes.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass, fields, replace

import numpy as np
import torch

from keyss.core.arrays import Doubles, Flags, Integers, Numbers, doubles
from keyss.core.errors import InputError
from keyss.core.gaussians import MAX_COORDINATE, MAX_LOG_SCALE, OPPONENT, Gaussians
from keyss.files.formats.common import morton_order, with_largest_w
from keyss.kernels.parallel import in_blocks
from keyss.methods.codec import entropy

_ALWAYS = 1 << 16  # number of Gaussians that a payload of any size may declare
_MIN_BYTES = 2  # minimum bytes per Gaussian of a larger model
_PER_CARRIER = 8  # maximum Gaussians of a larger model per Gaussian of the stego model, which may have losses
_HEAD = struct.Struct("<IB5f6ff")
BLOCK = 1 << 13  # Gaussians; half as many take 0.3 % more bytes, twice as many 0.2 % less
_SAMPLE = BLOCK // 4  # Gaussians of each block that are coded to estimate the size of a large model
_EXACT = 8 * BLOCK  # maximum Gaussians of a model whose size is not estimated
_TYPICAL = 1 << 16  # Gaussians that medians are taken of
_POSITION_STEP = 0.03  # relative to the median size of Gaussians
_DIFFERENCES = np.array([1.0, 1.5, 1.5])  # steps of brightness and differences of constant colours
_PER_OCTAVE = 0.5 / math.log(2)  # half octaves of the step
_FINER = 6  # maximum change of a step, in half octaves
_MAX_STEP = 1e6
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
        return [float(step) for step in steps.clip(1e-12, _MAX_STEP)]


def encode(model: Gaussians, precision: Precision | None = None) -> bytes:
    """Encode `model`, by default with the usual precision."""
    coder = _Encoder.of(model, precision)
    blocks = in_blocks(coder.code, len(model), BLOCK, entropy.write)
    return b"".join([coder.head, np.array([*map(len, blocks)], "<u4").tobytes(), *blocks])


def encoded_size(model: Gaussians, precision: Precision | None = None) -> int:
    """About the bytes of `encode`; for large models up to 2 % too many, but not too few, in half the time."""
    if len(model) <= _EXACT:
        return len(encode(model, precision))
    coder = _Encoder.of(model, precision)

    def size(start: int, stop: int) -> float:
        coded = min(stop, start + _SAMPLE)
        return 4 + len(coder.code(start, coded)) * (stop - start) / (coded - start)

    return len(coder.head) + math.ceil(sum(in_blocks(size, len(model), BLOCK, entropy.write)))


@dataclass(frozen=True)
class _Encoder:
    """Encodes blocks of a model."""

    model: Gaussians  # on the CPU
    order: Integers  # [N] rows of the model, sorted
    transparent: Flags  # [N] rows that become transparent
    centres: list[float]
    steps: list[float]
    typical: float = 0.0  # logarithm of a weight

    @staticmethod
    def of(model: Gaussians, precision: Precision | None) -> _Encoder:
        model = model.detach().to("cpu")
        order, transparent = morton_order(model.means.numpy()), model.overflow.numpy()
        rows = order[:: 1 + len(order) // _TYPICAL]
        some = model[torch.from_numpy(rows)]
        middle = [
            *np.median(some.means.numpy(), axis=0),
            np.median(some.log_scales.numpy()),
            np.median(some.opacity_logits.numpy()),
        ]
        limits = [*[MAX_COORDINATE] * 3, MAX_LOG_SCALE, _MAX_LOGIT]
        centres = [float(np.clip(centre, -most, most)) for centre, most in zip(middle, limits, strict=True)]
        steps = (precision or Precision.usual(model)).steps
        coder = _Encoder(model, order, transparent, centres, steps)
        codes = coder._uniform_codes(some, transparent[rows])
        _, log_scales, logits, _ = _uniform_numbers(codes, centres, steps)
        return replace(coder, typical=float(np.float32(np.median(_weight(log_scales, logits)))))

    @property
    def head(self) -> bytes:
        degree = self.model.sh_degree
        return _HEAD.pack(len(self.model), degree, *self.centres, *self.steps, self.typical)

    def code(self, start: int, stop: int) -> bytes:
        """Encode Gaussians `start` to `stop` in sorted order."""
        rows = self.order[start:stop]
        block = self.model[torch.from_numpy(rows)]
        codes = np.empty((len(block), 10 + 3 * block.sh.shape[1]), np.int32)
        codes[:, :10] = self._uniform_codes(block, self.transparent[rows])
        _, log_scales, logits, _ = _uniform_numbers(codes[:, :10], self.centres, self.steps)
        finer = _refinement(log_scales, logits, self.typical)
        quats = with_largest_w(doubles(block.quats))[:, 1:]
        codes[:, 10:13] = _round(quats / _steps(self.steps[4], finer))
        harmonics_steps = _steps(self.steps[5], finer).astype(np.float32)
        with np.errstate(over="ignore", invalid="ignore"):  # clamped below
            harmonics = _transformed(block.sh.numpy()[:, 1:] / harmonics_steps[:, None], OPPONENT)
        codes[:, 13:] = _round(harmonics.reshape(len(block), -1))
        return entropy.encode(codes, *_columns(self.model.sh_degree))

    def _uniform_codes(self, block: Gaussians, transparent: Flags) -> Doubles:
        """Codes [R, 10] of means, log scales, opacity logits and constant colours.

        Rasterizers skip Gaussians whose numbers overflow. Clamped numbers would make these visible, so they
        become transparent.
        """
        means, log_scales, logits, colours = (
            doubles(tensor)
            for tensor in (block.means, block.log_scales, block.opacity_logits[:, None], block.sh[:, 0])
        )
        logits[transparent] = -_MAX_LOGIT
        parts = [
            means.clip(-MAX_COORDINATE, MAX_COORDINATE),
            log_scales.clip(-MAX_LOG_SCALE, MAX_LOG_SCALE),
            logits.clip(-_MAX_LOGIT, _MAX_LOGIT),
            _transformed(colours, OPPONENT),
        ]
        return _round((np.concatenate(parts, axis=1) - _origin(self.centres)) / _uniform_steps(self.steps))


def decode(data: bytes, model_size: int | None = None) -> Gaussians:
    """Invert `encode`; `model_size`: Gaussians of the stego model. Raises InputError for damage.

    Memory is bounded: above 2^16 Gaussians, each takes at least 2 bytes of `data`, and the maximum is 8 times
    `model_size`.
    """
    if len(data) < _HEAD.size:
        raise InputError("the hidden secret is damaged: it is too short")
    count, sh_degree, *numbers = _HEAD.unpack_from(data)
    centres, steps, typical = numbers[:5], numbers[5:11], numbers[11]
    bounded = all(abs(number) < 1e30 for number in (*centres, typical)) and all(
        0 < s <= _MAX_STEP for s in steps
    )
    if not (count > 0 and sh_degree <= 3 and bounded):
        raise InputError(
            f"the hidden secret is damaged: it declares {count:,} Gaussians of SH degree {sh_degree}"
        )
    largest = len(data) // _MIN_BYTES
    if count > max(_ALWAYS, largest if model_size is None else min(largest, _PER_CARRIER * model_size)):
        held_by = f"{len(data):,} bytes" + ("" if model_size is None else f" in {model_size:,} Gaussians")
        raise InputError(
            f"the hidden secret is damaged: it declares {count:,} Gaussians, more than {held_by} can hold"
        )
    blocks = -(-count // BLOCK)
    first = _HEAD.size + 4 * blocks
    sizes = np.frombuffer(data[_HEAD.size : first].ljust(4 * blocks, b"\0"), "<u4").astype(np.int64)
    ends = first + np.cumsum(sizes)
    if ends[-1] != len(data):
        raise InputError("the hidden secret is damaged: its length is wrong")
    columns = _columns(sh_degree)
    means, log_scales, logits, quats, sh = (
        np.empty((count, *shape), np.float32) for shape in ((3,), (3,), (), (4,), ((sh_degree + 1) ** 2, 3))
    )

    def fill(start: int, stop: int) -> None:
        block = start // BLOCK
        coded = data[ends[block] - sizes[block] : ends[block]]
        codes = entropy.decode(coded, stop - start, *columns)
        rows = slice(start, stop)
        uniform = _uniform_numbers(codes[:, :10], centres, steps)
        means[rows], log_scales[rows], logits[rows] = uniform[:3]
        finer = _refinement(uniform[1], uniform[2], typical)
        x, y, z = (codes[:, 10:13] * _steps(steps[4], finer)).T
        w = np.sqrt(np.maximum(1 - (x * x + y * y + z * z), _LEAST_W))
        quats[rows] = np.stack([w, x, y, z], axis=1)
        sh[rows, :1] = _transformed(uniform[3][:, None], OPPONENT.T)
        harmonics = codes[:, 13:] * _steps(steps[5], finer)
        sh[rows, 1:] = _transformed(harmonics.reshape(len(codes), -1, 3), OPPONENT.T)

    in_blocks(fill, count, BLOCK, entropy.read)
    return Gaussians(*map(torch.from_numpy, (means, quats, log_scales, logits, sh)))


def _columns(sh_degree: int) -> tuple[Integers, Integers]:
    """`shares` and `groups` of all columns."""
    others = (sh_degree + 1) ** 2 - 1
    return np.array([*_SHARES, *[0, 0, 0] * others]), np.array([*_GROUPS, *[6, 7, 7] * others])


def _round(numbers: Numbers) -> Numbers:
    bounded: Numbers = np.nan_to_num(numbers).clip(-entropy.MAX_NUMBER, entropy.MAX_NUMBER)
    return np.rint(bounded)


def _origin(centres: list[float]) -> Doubles:
    """The numbers [10] to subtract from the `_uniform_columns`."""
    x, y, z, scales, logit = centres
    return np.array([x, y, z, scales, scales, scales, logit, 0, 0, 0])


def _uniform_steps(steps: list[float]) -> Doubles:
    """Steps [10] of the columns whose step is the same for all Gaussians."""
    means, log_scales, opacity, colours, *_ = steps
    return np.array([*[means] * 3, *[log_scales] * 3, opacity, *colours * _DIFFERENCES])


def _uniform_numbers(codes: Numbers, centres: list[float], steps: list[float]) -> list[Doubles]:
    """Means [N, 3], log scales [N, 3], opacity logits [N] and colours [N, 3] from codes [N, 10]."""
    numbers = codes * _uniform_steps(steps) + _origin(centres)
    return [numbers[:, :3], numbers[:, 3:6], numbers[:, 6], numbers[:, 7:]]


def _transformed(values: Numbers, matrix: Doubles) -> Numbers:
    """`values` [..., 3] @ matrix.T in a fixed order of operations; OPPONENT.T inverts OPPONENT."""
    products = np.empty_like(values)
    for at, (a, b, c) in enumerate(matrix.tolist()):
        products[..., at] = a * values[..., 0] + b * values[..., 1] + c * values[..., 2]
    return products


def _weight(log_scales: Doubles, logits: Doubles) -> Doubles:
    """Logarithms [N] of weights."""
    scales = np.sort(log_scales, axis=1)
    # log(opacity) is about min(logit, 0)
    visibility: Doubles = scales[:, 2] + scales[:, 1] + 2 * np.minimum(logits, 0)
    return visibility


def _refinement(log_scales: Doubles, logits: Doubles, typical: float) -> Integers:
    """Half octaves [N] by which the other steps of each Gaussian are finer than those of typical ones."""
    octaves = (_weight(log_scales, logits) - typical) * _PER_OCTAVE
    whole: Integers = np.floor(octaves + 0.5).astype(np.int64)
    return whole.clip(-_FINER, _FINER)


def _steps(step: float, finer: Integers) -> Doubles:
    """Steps [N, 1]: `step` times a power of two, and the square root of two for odd `finer`."""
    steps: Doubles = step * np.where(finer % 2, math.sqrt(2), 1.0) * 2.0 ** -((finer + 1) // 2)
    return steps[:, None]
