"""What the kernels of records compute, by numpy: slow, and plain to read."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch

from keyss.core.colour import OPPONENT
from keyss.core.gaussians import MAX_COORDINATE, MAX_LOG_SCALE, Gaussians
from keyss.methods.records.lines import Codes, Floats, Line, neighbourhood
from keyss.methods.records.packing import Bytes, packed
from keyss.methods.records.quantise import MAX_LOGIT, Codec, Mask, _kinds
from keyss.methods.records.table import BANDS, CHROMA_FEWER, Table

_QUAT_LINE = Line(0, 0, 0.5**0.5)
_MIN_LENGTH, _MAX_HARMONIC = 1e-12, 1e6


def encode(codec: Codec, gaussians: Gaussians) -> Bytes:
    """[N, record_bytes]."""
    return packed(_codes(codec, gaussians, outliers(gaussians)))


def outliers(gaussians: Gaussians) -> Mask:
    """[N] by all Gaussians."""
    found = np.zeros(len(gaussians), bool)
    kinds = _kinds(gaussians.sh_degree)
    for (values, _), kind in zip(numbers(gaussians, Table.floor(gaussians.sh_degree)), kinds, strict=True):
        low, high = neighbourhood(values, kind)
        found |= ((values < low) | (values > high)).any(axis=1)
    return found if not found.all() else ~found


def _codes(codec: Codec, gaussians: Gaussians, outlier: Mask) -> Iterator[tuple[Codes, int]]:
    """Columns of codes and the bits of each."""
    yield outlier[:, None].astype(np.uint32), 1
    left_out, three = _three_smallest(_doubles(gaussians.quats))
    yield left_out, 2
    yield _QUAT_LINE.encode(three, codec.table.bits[2]), codec.table.bits[2]
    every = numbers(gaussians, codec.table)
    for line, far, (values, bits) in zip(codec.lines, codec.far, every, strict=True):
        codes = line.encode(values, bits)
        codes[outlier] = far.encode(values[outlier], bits)
        yield codes, bits


def decode(codec: Codec, records: Bytes) -> Gaussians:
    """The inverse of `encode`."""
    means, log_scales, quats, opacity, *colours = codec.table.bits
    lines = iter(zip(codec.lines, codec.far, strict=True))
    unread = np.unpackbits(records, axis=1)

    def codes(columns: int, bits: int) -> Codes:
        """[N, columns] the next codes, in the order in which they were packed."""
        nonlocal unread
        part, unread = np.split(unread, [columns * bits], axis=1)
        powers = np.uint32(1) << np.arange(bits, dtype=np.uint32)[::-1]
        return part.reshape(-1, columns, bits) @ powers

    outlier = codes(1, 1)[:, 0] > 0

    def values(columns: int, bits: int) -> Floats:
        (line, far), read = next(lines), codes(columns, bits)
        found = line.decode(read, bits)
        found[outlier] = far.decode(read[outlier], bits)
        return found

    left_out = codes(1, 2)
    turns = _whole_quats(left_out, _QUAT_LINE.decode(codes(3, quats), quats))
    positions = np.concatenate([values(1, means) for _ in range(3)], axis=1)
    sizes, logits = values(3, log_scales), values(1, opacity)[:, 0]
    harmonics = []
    for count, bits in zip(BANDS, colours, strict=False):
        brightness = values(count, bits)[:, :, None]
        differences = values(2 * count, bits - CHROMA_FEWER).reshape(-1, count, 2)
        harmonics.append(np.concatenate([brightness, differences], axis=2) @ OPPONENT)
    sh = np.concatenate(harmonics, axis=1)
    return Gaussians(*(torch.from_numpy(v).float() for v in (positions, turns, sizes, logits, sh)))


def _three_smallest(quats: Floats) -> tuple[Codes, Floats]:
    """[N, 1] which component is the largest, and [N, 3] the others, of the unit quaternion with it > 0."""
    length = np.linalg.norm(quats, axis=1, keepdims=True)
    turned = length > _MIN_LENGTH
    unit = np.where(turned, quats / np.where(turned, length, 1), [1.0, 0, 0, 0])
    largest = np.abs(unit).argmax(axis=1)[:, None]
    unit = unit * np.where(np.take_along_axis(unit, largest, 1) < 0, -1.0, 1.0)
    others = np.arange(3) + (np.arange(3) >= largest)
    return largest.astype(np.uint32), np.take_along_axis(unit, others, 1)


def _whole_quats(largest: Codes, three: Floats) -> Floats:
    """[N, 4] unit quaternions; codes that no quaternion has give one all the same."""
    index = largest.astype(np.int64)
    quats = np.empty((len(three), 4))
    np.put_along_axis(quats, np.arange(3) + (np.arange(3) >= index), three, 1)
    rest = np.sqrt((1 - np.square(three).sum(axis=1, keepdims=True)).clip(0))
    np.put_along_axis(quats, index, rest, 1)
    quats /= np.linalg.norm(quats, axis=1, keepdims=True).clip(0.5)
    return quats


def numbers(gaussians: Gaussians, table: Table) -> Iterator[tuple[Floats, int]]:
    """All numbers but the quaternions, those of each line together, in the order in which they are stored.

    A Gaussian that is never drawn becomes transparent, so that its numbers in the limits are not drawn
    either.
    """
    means, log_scales, _, opacity, *colours = table.bits
    positions = _doubles(gaussians.means.clamp(-MAX_COORDINATE, MAX_COORDINATE))
    for axis in range(3):
        yield positions[:, axis : axis + 1], means
    sizes = _doubles(gaussians.log_scales.clamp(-MAX_LOG_SCALE, MAX_LOG_SCALE))
    yield sizes, log_scales
    logits = gaussians.opacity_logits.masked_fill(gaussians.overflow, -MAX_LOGIT)
    yield _doubles(logits.clamp(-MAX_LOGIT, MAX_LOGIT))[:, None], opacity
    for band, bits in enumerate(colours):
        harmonics = gaussians.sh[:, band**2 : (band + 1) ** 2].clamp(-_MAX_HARMONIC, _MAX_HARMONIC)
        rotated = _doubles(harmonics) @ OPPONENT.T
        yield rotated[:, :, 0], bits
        yield rotated[:, :, 1:].reshape(len(rotated), -1), bits - CHROMA_FEWER


def _doubles(values: torch.Tensor) -> Floats:
    return values.detach().cpu().numpy().astype(np.float64)
