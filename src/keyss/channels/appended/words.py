"""Words of 84 bits as Gaussians, readable after a format has rounded them.

Every number is a point of a lattice coarser than the rounding of any format (docs/channels.md):

    39 bits  invariant under similarities: three colours of 7 bits, three log scales of 6
    45 bits  in the *own frame*, a cube around the model: three positions of 10 bits; x, y and z of the
             quaternion, whose w is positive and the largest, of 5 bits each

Opacity is just above 1/255, which 8 bits round to 1.

A *packet* is a word of 6 or 8 bytes of data and a tag, which looks random without the key. The tag fills the
word: it is the packet's number, masked with the AES-256 encryption of the data. Under the right key, packets
have valid numbers and other words rarely do; Reed-Solomon corrects the few that do.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from keyss.channels.mixing import encrypted_blocks
from keyss.core.arrays import Bits, Bytes, Doubles, Flags, Integers, Words, doubles
from keyss.core.errors import UsageError
from keyss.core.gaussians import DRAWN_OPACITY, Gaussians
from keyss.core.similarity import Similarity
from keyss.files.formats.common import with_largest_w

_WIDTHS = COLOUR_BITS, SCALE_BITS, POSITION_BITS, ROTATION_BITS = 7, 6, 10, 5
INVARIANT_BITS = 3 * (COLOUR_BITS + SCALE_BITS)
WORD_BITS = INVARIANT_BITS + 3 * (POSITION_BITS + ROTATION_BITS)

# Programs remove Gaussians below 1/255; rasterizers draw those above, here to a hundredth of a standard
# deviation from the centre. At 1.1/255, 360,000 of them would lower the cover to 40 dB.
_OPACITY = 1.00001 * DRAWN_OPACITY
_LOGIT = math.log(_OPACITY / (1 - _OPACITY))
_FAINTEST, _STRONGEST = 0.4 * DRAWN_OPACITY, 1.6 * DRAWN_OPACITY  # opacities of words after rounding
_COLOUR_STEP = 0.0275  # a little above twice the largest rounding error of formats
SCALE_STEP = 0.08  # of log scales; also above twice the largest rounding error
_MIN_LOG_SCALE = -9.9  # `.spz` stores -10 and more
_SMALL = -9.0  # smallest log scale, relative to the cube's
# Bound of x, y and z, so that w is the largest. A step is 16 of `.spz`, which compress better.
_ROTATION_REACH = 256 / 511 * 0.5**0.5
_FARTHEST, _MAX_SHIFTS = 1 << 12, 500  # range of log scales, in steps; maximum number of offsets to try
HEADERS = 40  # copies of a header
_HEADER_BITS = 20
_MIN_VOTES = 12  # headers; fewer can agree by chance among a million words


def candidate_mask(model: Gaussians) -> Flags:
    """Mask [N] of finite Gaussians as faint as appended ones."""
    opacities = model.opacities.detach().cpu().numpy()
    faint: Flags = (opacities > _FAINTEST) & (opacities < _STRONGEST)
    for values in (model.means, model.quats, model.log_scales, model.sh):
        faint &= np.isfinite(values.detach().cpu().numpy()).reshape(len(faint), -1).all(axis=1)
    return faint


def is_appended(model: Gaussians) -> Tensor:
    """Mask [N] of appended Gaussians in a model that no format has rounded since.

    They share one opacity. Another Gaussian has it to the last bit with a probability below 10^-6.
    """
    return model.opacity_logits == float(np.float32(_LOGIT))


def own_frame(model: Gaussians) -> Similarity:
    """Own frame to world: the unit cube covers most of the model.

    Scale and translation give lattice points coordinates of few bits, which `.spz` compresses better.
    """
    means = doubles(model.means)
    means = means[np.isfinite(means).all(axis=1)]
    low, high = np.quantile(means, [0.05, 0.95], axis=0) if len(means) else np.zeros((2, 3))
    size = float((high - low).max())
    size = 2.0 ** round(math.log2(size)) if 0 < size < math.inf else 1.0
    step = size / 2**POSITION_BITS
    return Similarity(size, translation=torch.from_numpy(np.rint((low + high - size) / 2 / step) * step))


def check_place(to_world: Similarity) -> None:
    """Raise UsageError if float32 rounds positions in the own frame by more than a quarter of a step."""
    corner = to_world.translation.numpy()
    step = to_world.scale / 2**POSITION_BITS
    if float(np.spacing(np.float32(np.abs(corner).max()))) > step / 4:
        x, y, z = corner
        away = f"{x:.9g},{y:.9g},{-z:.9g}"  # splat-transform's axes are rotated by 180 degrees about z
        raise UsageError(
            "the cover is too far from the origin for the single precision of its file: move it, e.g. with "
            f"`splat-transform IN -t {away} OUT.ply`"
        )


def sort_by_rotation(words: Bits) -> Bits:
    """Sort `words` by z, y and x of their quaternions: `.spz` compresses runs of equal rotations."""
    rotations = words[:, -3 * ROTATION_BITS :].reshape(-1, 3, ROTATION_BITS)[:, ::-1]
    return words[np.lexsort(rotations.reshape(len(words), -1).T[::-1])]  # primary key: the highest bit of z


def to_gaussians(words: Bits, to_world: Similarity, sh_degree: int) -> Gaussians:
    """N Gaussians from words [N, WORD_BITS]; `to_world`: the result of `own_frame`."""
    least_log_scale = max(_SMALL, _MIN_LOG_SCALE - math.log(to_world.scale))
    fields = _split(words)
    colours = (fields[0] + 0.5) * _COLOUR_STEP - _COLOUR_STEP * 2 ** (COLOUR_BITS - 1)
    scales = fields[1] * SCALE_STEP + least_log_scale
    positions = (fields[2] + 0.5) / 2**POSITION_BITS
    parts = (fields[3] + 0.5) / 2**ROTATION_BITS * 2 * _ROTATION_REACH - _ROTATION_REACH
    w = np.sqrt(1 - np.square(parts).sum(axis=1, keepdims=True))
    sh = np.zeros((len(words), (sh_degree + 1) ** 2, 3))
    sh[:, 0] = colours
    logits = np.full(len(words), _LOGIT)
    numbers = (positions, np.concatenate([w, parts], axis=1), scales, logits, sh)
    model = Gaussians(*(torch.from_numpy(column).float() for column in numbers))
    return to_world.apply_gaussians(model)


def colours_of(model: Gaussians) -> Integers:
    """Nearest lattice points [N, 3] of colours."""
    colours = doubles(model.sh[:, 0])
    return _nearest(colours / _COLOUR_STEP + 2 ** (COLOUR_BITS - 1) - 0.5, COLOUR_BITS)


def scales_at(steps: Doubles, shift: float) -> Integers:
    """Nearest lattice points [N, 3] of log scales / SCALE_STEP, for a lattice with offset `shift`."""
    return _nearest(steps - shift, SCALE_BITS)


def likely_shifts(steps: Doubles) -> list[float]:
    """Offsets of the lattice if most log scales lie on it, the likeliest first.

    Scaling a model shifts all log scales by one number.
    """
    phase = float(np.angle(np.exp(2j * np.pi * steps).mean())) / (2 * np.pi)
    whole = np.rint(steps - phase).clip(-_FARTHEST, _FARTHEST).astype(np.int64)
    counts = np.bincount((whole + _FARTHEST).ravel(), minlength=2 * _FARTHEST)
    inside = np.convolve(counts, np.ones(2**SCALE_BITS, np.int64))  # at i: scales on a lattice that ends at i
    best = int(inside.argmax()) - 2**SCALE_BITS + 1 - _FARTHEST
    return [best + phase + offset for offset in (0, 1, -1, 2, -2)]


def all_shifts(steps: Doubles) -> Doubles:
    """Offsets [S] of the lattice to try if only some log scales lie on it."""
    low, high = np.quantile(steps.clip(-_FARTHEST, _FARTHEST), [0.01, 0.99])
    most = min(high - 2 ** (SCALE_BITS - 2), low + _MAX_SHIFTS)
    return np.arange(low - 2 ** (SCALE_BITS - 1), max(most, low), 0.25)


def points_in_frame(model: Gaussians, to_own: Similarity) -> tuple[Integers, Integers]:
    """Nearest lattice points [N, 3] of positions and of rotations; `to_own`: world to own frame."""
    framed = to_own.apply_gaussians(model.with_sh_degree(0))
    positions = framed.means.double().numpy() * 2**POSITION_BITS - 0.5
    parts = with_largest_w(framed.quats.double().numpy())[:, 1:]
    rotations = (parts + _ROTATION_REACH) / (2 * _ROTATION_REACH) * 2**ROTATION_BITS - 0.5
    return _nearest(positions, POSITION_BITS), _nearest(rotations, ROTATION_BITS)


def pack_words(*fields: Integers) -> Bits:
    """Words [N, WORD_BITS] from colours, scales, positions and rotations, [N, 3] each."""
    both = zip(fields, _WIDTHS, strict=True)
    bits = [bits_of(column.astype(np.uint64), width) for columns, width in both for column in columns.T]
    return np.concatenate(bits, axis=1)


def invariants_of(colours: Integers, scales: Integers) -> Words:
    """The first INVARIANT_BITS of words [N], from colours and scales [N, 3]."""
    colour_bits = colours @ (1 << COLOUR_BITS * np.arange(3)[::-1])
    scale_bits = scales @ (1 << SCALE_BITS * np.arange(3)[::-1])
    return (colour_bits << 3 * SCALE_BITS | scale_bits).astype(np.uint64)


def bits_of(numbers: Words, count: int) -> Bits:
    """The inverse of `_number`: bits [N, count]."""
    shifts = np.arange(count, dtype=np.uint64)[::-1]
    return (numbers[:, None] >> shifts & np.uint64(1)).astype(np.uint8)


def write_packets(key: bytes, numbers: Words, data: Bytes) -> Bits:
    """Words [N, WORD_BITS] of packets with `numbers` [N] and `data` [N, width]; `key`: 32 bytes."""
    tag_bits = WORD_BITS - 8 * data.shape[1]
    tags = bits_of(_masks(key, data, tag_bits) ^ numbers, tag_bits)
    return np.concatenate([np.unpackbits(data, axis=1), tags], axis=1)


def read_packets(key: bytes, words: Bits, width: int) -> tuple[Words, Bytes]:
    """Numbers [N] and data [N, width] of words [N, WORD_BITS], as if all were packets."""
    data = np.packbits(words[:, : 8 * width], axis=1)
    tags = words[:, 8 * width :]
    return _number(tags) ^ _masks(key, data, tags.shape[1]), data


def read_header(key: bytes, words: Bits, width: int) -> int | None:
    """The value of the headers by majority; None if too few agree. Copies of one word have one vote."""
    numbers, data = read_packets(key, words, width)
    numbers = numbers[np.unique(data.view(f"V{width}")[:, 0], return_index=True)[1]]
    votes = np.bincount(numbers[numbers < 1 << _HEADER_BITS].astype(np.int64), minlength=1)
    return int(votes.argmax()) if votes.max() >= _MIN_VOTES else None


def _number(bits: Bits) -> Words:
    """Integers [N] from bits [N, B], most significant first; B is at most 64."""
    powers = np.uint64(1) << np.arange(bits.shape[1], dtype=np.uint64)[::-1]
    return bits.astype(np.uint64) @ powers


def _masks(key: bytes, data: Bytes, bits: int) -> Words:
    """Masks [N] of tags."""
    blocks = np.zeros((len(data), 16), np.uint8)
    blocks[:, : data.shape[1]] = data
    return encrypted_blocks(key, blocks).view(">u8")[:, 0].astype(np.uint64) >> np.uint64(64 - bits)


def _split(words: Bits) -> list[Doubles]:
    """Colours, scales, positions and rotations, [N, 3] each."""
    fields, at = [], 0
    for width in _WIDTHS:
        columns = words[:, at : at + 3 * width].reshape(-1, 3, width)
        fields.append(columns.astype(np.float64) @ 2.0 ** np.arange(width)[::-1])
        at += 3 * width
    return fields


def _nearest(steps: Doubles, bits: int) -> Integers:
    return np.rint(steps).clip(0, 2**bits - 1).astype(np.int64)
