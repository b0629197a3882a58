"""Shared by formats: checks, quantisation of attributes, spatial order."""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from dataclasses import fields, replace
from typing import ClassVar, Self

import numpy as np
import torch
from torch import Tensor

from keyss.core.arrays import Bytes, Doubles, Floats, Integers, Numbers, Words
from keyss.core.errors import InputError, KeyssWarning, OutputError, not_whole
from keyss.core.gaussians import SH_C0, Gaussians
from keyss.files.ply_table import OPACITY_LOGIT_BOUND
from keyss.kernels.parallel import in_blocks

# A compressed file of more Gaussians than SMALL_COUNT must have at least MIN_BYTES for each. Published models
# take 7 and more, those of degree 3 10 and more (appended ones, which have no harmonics).
SMALL_COUNT, MIN_BYTES = 1 << 17, 6
BLOCK = 1 << 14  # Gaussians converted at a time, a multiple of the chunks of compressed .ply
_MORTON_BITS = 21  # per axis
_SORTED = 0.9  # minimum share of ascending neighbours


class Codes(ABC):
    """The integers of a file in a quantised format: base of dataclasses of arrays.

    `parse` and `serialise` convert between bytes and codes, losslessly; `quantise` and `dequantise` between
    models and codes.
    """

    name: ClassVar[str]  # for users
    sorts: ClassVar[bool] = True  # whether `write` reorders Gaussians

    positions: Numbers  # [N, 3]

    def __len__(self) -> int:
        """Number of Gaussians."""
        return len(self.positions)

    @classmethod
    @abstractmethod
    def parse(cls, data: bytes) -> Self:
        """The codes of a file. Raises InputError if it is not complete."""

    @abstractmethod
    def serialise(self) -> bytes:
        """A file of the codes."""

    @classmethod
    @abstractmethod
    def quantise(cls, model: Gaussians) -> Self:
        """The codes nearest to a model, in its order. Raises OutputError for values out of range."""

    @abstractmethod
    def decode_part(self, part: slice) -> Gaussians:
        """Some of the Gaussians, in the frame of a .ply; `part` is one of `blocks_of`."""

    def dequantise(self) -> Gaussians:
        """The model in the frame of a .ply. Raises InputError if it is not finite."""
        return assembled(len(self), map(self.decode_part, blocks_of(len(self))))

    @classmethod
    def of(cls, model: Gaussians) -> Self:
        """The codes of the model's file if it has this format, else of the quantised model."""
        if isinstance(model, CodedGaussians) and isinstance(model.codes, cls):
            return model.codes
        model = writable(model)
        return cls.quantise(in_morton_order(model) if cls.sorts else model)

    @classmethod
    def read(cls, data: bytes) -> CodedGaussians:
        """The model in a file. Raises InputError."""
        return CodedGaussians.of(cls.parse(data))

    @classmethod
    def write(cls, model: Gaussians) -> bytes:
        """A model as a file. Raises OutputError."""
        return cls.of(model).serialise()


class CodedGaussians(Gaussians):
    """The model of a file with its codes. Only `to` keeps them; derived models are plain `Gaussians`."""

    __slots__ = ("codes",)  # not in vars(), which holds the tensors

    codes: Codes

    @staticmethod
    def of(codes: Codes, model: Gaussians | None = None) -> CodedGaussians:
        """The dequantised model; `model` is given if it has been decoded before."""
        model = codes.dequantise() if model is None else model
        coded = CodedGaussians(*(getattr(model, field.name) for field in fields(model)))
        object.__setattr__(coded, "codes", codes)
        return coded

    def to(self, device: torch.device | str) -> Gaussians:
        moved = super().to(device)
        return CodedGaussians.of(self.codes, moved) if hasattr(self, "codes") else moved  # after `replace`


def reason(error: Exception) -> str:
    """A library's message, truncated, since it may quote the file at any length."""
    return str(error)[:200]


def check_count(count: int, size: int, least: float = MIN_BYTES) -> None:
    """Raise InputError if a compressed file of `size` bytes cannot hold `count` Gaussians, or holds none.

    `least`: bytes of a Gaussian, so that its values in memory are a bounded multiple.
    """
    if count < 1:
        raise InputError("it holds no Gaussians")
    if count > max(SMALL_COUNT, size / least):
        raise not_whole("model", f"it announces {count:,} Gaussians, more than {size:,} bytes hold")


def check_sh_degree(degree: int) -> int:
    """Number of SH coefficients without the constant one. Raises InputError above degree 3."""
    if not 0 <= degree <= 3:
        raise InputError(f"expected spherical harmonics of degree 0 to 3, found {degree}")
    return (degree + 1) ** 2 - 1


def gaussians_of(
    means: Numbers,
    quats: Numbers,
    log_scales: Numbers,
    opacities: Numbers,  # [N] in [0, 1]
    colors: Numbers,  # [N, 3], f_dc
    rest: Numbers,  # [N, K - 1, 3], the other harmonics
) -> Gaussians:
    """A model from arrays, with opacities in place of logits.

    Values that are not finite in single precision become infinite or NaN.
    """
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        sh = np.empty((len(rest), 1 + rest.shape[1], 3), np.float32)
        sh[:, 0], sh[:, 1:] = colors, rest
        share = np.asarray(opacities, dtype=np.float64)
        logits = (np.log(share) - np.log1p(-share)).clip(-OPACITY_LOGIT_BOUND, OPACITY_LOGIT_BOUND)
        parts = (means, quats, log_scales, logits, sh)
        return Gaussians(*(torch.from_numpy(np.require(part, np.float32, ["C", "W"])) for part in parts))


def blocks_of(count: int) -> Iterator[slice]:
    """Slices of at most BLOCK that cover `count` Gaussians."""
    return (slice(start, min(start + BLOCK, count)) for start in range(0, count, BLOCK))


def assembled(count: int, blocks: Iterable[Gaussians], *, drop: bool = False) -> Gaussians:
    """A model of `count` Gaussians in blocks, which take memory one at a time.

    Raises InputError for values that are not finite. `drop`: leaves out Gaussians with such values, with a
    KeyssWarning, unless none would remain.
    """
    whole: list[Tensor] = []
    wrong: dict[str, None] = {}  # an ordered set
    end = 0
    for block in blocks:
        if names := _not_finite(block):
            wrong |= dict.fromkeys(names)
            columns = [getattr(block, field.name).reshape(len(block), -1) for field in fields(block)]
            block = block[torch.cat(columns, dim=1).isfinite().all(1)]
        parts = [getattr(block, field.name) for field in fields(block)]
        whole = whole or [part.new_empty((count, *part.shape[1:])) for part in parts]
        for column, part in zip(whole, parts, strict=True):
            column[end : end + len(part)] = part
        end += len(block)
    if wrong and not (drop and end):
        raise InputError(f"NaN or infinite values in {', '.join(wrong)}")
    if end < count:
        warnings.warn(
            f"{count - end:,} of {count:,} Gaussians are left out: they have NaN or infinite values "
            f"({', '.join(wrong)})",
            KeyssWarning,
            stacklevel=2,
        )
    return Gaussians(*(column[:end] for column in whole))


def _not_finite(model: Gaussians) -> list[str]:
    """Names of attributes with NaN or infinite values."""
    # A finite sum has finite terms, and takes a thirtieth of the time.
    values = {field.name: getattr(model, field.name) for field in fields(model)}
    return [
        name for name, column in values.items() if not (column.sum().isfinite() or column.isfinite().all())
    ]


def writable(model: Gaussians) -> Gaussians:
    """`model` on the CPU with finite opacity logits. Raises OutputError if it is empty or not finite."""
    if isinstance(model, CodedGaussians):  # checked when it was read
        return model.to("cpu")
    flat = model.detach().to("cpu")
    if len(flat) == 0:
        raise OutputError("it holds no Gaussians")
    logits, bound = flat.opacity_logits, OPACITY_LOGIT_BOUND
    flat = replace(flat, opacity_logits=logits.where(~logits.isinf(), logits.clamp(-bound, bound)))
    if wrong := _not_finite(flat):
        raise OutputError(f"NaN or infinite values in {', '.join(wrong)}")
    return flat


def arrays_of(model: Gaussians) -> tuple[Floats, Doubles, Floats, Doubles, Floats, Floats]:
    """The arguments of `gaussians_of`, from a model on any device. Rounds: opacities, unit quaternions."""
    flat = model.detach().to("cpu")
    parts = (flat.means, flat.quats, flat.log_scales, flat.opacity_logits, flat.sh)
    means, quats, log_scales, opacity_logits, sh = (part.numpy() for part in parts)
    with np.errstate(over="ignore"):
        opacities = 1 / (1 + np.exp(-opacity_logits.astype(np.float64)))
    return means, unit(quats), log_scales, opacities, sh[:, 0], sh[:, 1:]


def round_half_away(values: Numbers) -> Doubles:
    """Integers nearest to `values`, halves away from 0, like C's `round`."""
    return np.copysign(np.floor(np.abs(values) + 0.5), values)


def to_bytes(values: Numbers, maximum: int = 255) -> Numbers:
    """`values` rounded and clipped to 0 to `maximum`, as uint8 or, above 255, uint16."""
    kind = np.uint8 if maximum < 256 else np.uint16
    return round_half_away(values).clip(0, maximum).astype(kind)


def colour_bytes(f_dc: Floats) -> Bytes:
    """[..., 3] 8-bit colours of the constant harmonic, clipped."""
    return to_bytes((0.5 + SH_C0 * f_dc.astype(np.float64)) * 255)


def f_dc_of(colors: Numbers) -> Doubles:
    """f_dc of colours in [0, 1]."""
    return (np.asarray(colors, dtype=np.float64) - 0.5) / SH_C0


def log_scales_of(scales: Numbers) -> Doubles:
    """Logarithms of scales: 0 becomes the smallest normal number, negative scales NaN."""
    with np.errstate(invalid="ignore"):
        values = np.asarray(scales, dtype=np.float64)
        logs: Doubles = np.log(np.where(values == 0, np.finfo(np.float32).tiny, values))
    return logs


def scales_of(log_scales: Floats) -> Floats:
    """Scales, clipped to the range of float32."""
    return np.exp(log_scales.astype(np.float64)).clip(0, np.finfo(np.float32).max).astype(np.float32)


def unit(quats: Numbers) -> Doubles:
    """[N, 4] normalised quaternions; zero becomes (1, 0, 0, 0), as in renderers."""
    values = quats.astype(np.float64)
    length = np.linalg.norm(values, axis=1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        units: Doubles = np.where(length > 0, values / length, [1.0, 0.0, 0.0, 0.0])
    return units


def with_largest_w(quats: Doubles) -> Doubles:
    """[N, 4] unit quaternions wxyz of the same ellipsoids, with w the largest component.

    An ellipsoid is unchanged by 180 degrees about one of its axes, which some programs add.
    """
    quats = quats / np.linalg.norm(quats, axis=1, keepdims=True).clip(1e-30)
    largest = np.abs(quats).argmax(axis=1)
    order = np.array([[0, 1, 2, 3], [1, 0, 3, 2], [2, 3, 0, 1], [3, 2, 1, 0]])  # q, q i, q j, q k
    signs = np.array([[1, 1, 1, 1], [-1, 1, 1, -1], [-1, -1, 1, 1], [-1, 1, -1, 1]])
    turned = np.take_along_axis(quats, order[largest], 1) * signs[largest]
    quaternion: Doubles = turned * np.where(turned[:, :1] < 0, -1.0, 1.0)
    return quaternion


def smallest_three(quats: Doubles) -> tuple[Bytes, Doubles]:
    """Index of the largest component [N] of unit quaternions [N, 4], and the other three [N, 3].

    Signs are such that the largest component is positive; the others are within +-sqrt(1/2).
    """
    largest = np.abs(quats).argmax(axis=1)
    sign = np.where(np.take_along_axis(quats, largest[:, None], axis=1) < 0, -1.0, 1.0)
    return largest.astype(np.uint8), np.take_along_axis(quats * sign, _OTHERS[largest], axis=1)


def from_smallest_three(largest: Bytes, others: Doubles) -> Doubles:
    """[N, 4] unit quaternions, inverse of `smallest_three`; the largest is 0 if `others` exceed length 1."""
    quats = np.empty((len(largest), 4))
    np.put_along_axis(quats, _OTHERS[largest], others, axis=1)
    rest = np.sqrt(np.maximum(0.0, 1 - np.square(others).sum(axis=1)))
    np.put_along_axis(quats, largest[:, None].astype(np.intp), rest[:, None], axis=1)
    return quats


_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])  # indices other than the largest component's


def in_morton_order(model: Gaussians) -> Gaussians:
    """`model` on the CPU, sorted by `morton_order`."""
    model = model.detach().to("cpu")
    return model[torch.from_numpy(morton_order(model.means.numpy()))]


def morton_order(means: Floats) -> Integers:
    """[N] indices that sort positions along a Z-order curve."""
    return np.argsort(morton_keys(means, means), kind="stable")


def morton_keys(positions: Floats | Doubles, within: Floats | Doubles) -> Words:
    """[N] places of positions on the Z-order curve through the bounding box of `within` [M, 3].

    Positions outside count as on its border. A place never falls as a coordinate grows.
    """
    low, high = within.min(axis=0).astype(np.float64), within.max(axis=0).astype(np.float64)
    extent = np.where(high > low, high - low, 1.0)

    def keys(start: int, stop: int) -> Words:
        # Spread the bits of each coordinate: two zeros between neighbours are the places of the other two.
        cells = (((positions[start:stop] - low) / extent).clip(0, 1) * (2**_MORTON_BITS - 1)).astype(
            np.uint64
        )
        for shift, mask in (
            (32, 0x1F00000000FFFF),
            (16, 0x1F0000FF0000FF),
            (8, 0x100F00F00F00F00F),
            (4, 0x10C30C30C30C30C3),
            (2, 0x1249249249249249),
        ):
            cells = (cells | (cells << np.uint64(shift))) & np.uint64(mask)
        places: Words = np.bitwise_or.reduce(cells << np.arange(3, dtype=np.uint64), axis=1)
        return places

    return np.concatenate([np.empty(0, np.uint64), *in_blocks(keys, len(positions), BLOCK)])


def is_in_morton_order(means: Floats) -> bool:
    """True for positions in `morton_order`, up to a few."""
    places = np.empty(len(means))
    places[morton_order(means)] = np.arange(len(means))
    return len(means) > 1 and bool((np.diff(places) > 0).mean() >= _SORTED)
