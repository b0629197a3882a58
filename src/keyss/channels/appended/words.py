"""Words of 84 bits as Gaussians, and back after a format has rounded them.

Every number of such a Gaussian is a point of a lattice that is coarser than what formats do to it
(docs/channels.md):

    39 bits  that stay when a model is moved, turned or scaled: three colours of 7 bits, three log scales of 6
    45 bits  in the *own frame*, a cube around the model: three positions of 10 bits, and of the quaternion,
             whose w is the largest part and positive, x, y and z, 5 bits each

Opacity is just above 1/255; 8 bits keep it as 1.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from keyss.core.arrays import Bits, Doubles, Flags, Integers, Words, doubles
from keyss.core.errors import UsageError
from keyss.core.gaussians import DRAWN_OPACITY, Gaussians
from keyss.core.similarity import Similarity
from keyss.files.formats.common import with_largest_w

COLOUR_BITS, SCALE_BITS, POSITION_BITS, TURN_BITS = 7, 6, 10, 5
INVARIANT_BITS = 3 * (COLOUR_BITS + SCALE_BITS)
WORD_BITS = INVARIANT_BITS + 3 * (POSITION_BITS + TURN_BITS)

# Programs remove what is below 1/255, and rasterizers draw what is above: here only a hundredth of a standard
# deviation around the centre. With 1.1/255, 360,000 of them would leave a cover at 40 dB.
_OPACITY = 1.00001 * DRAWN_OPACITY
_LOGIT = math.log(_OPACITY / (1 - _OPACITY))
_FAINTEST, _STRONGEST = 0.4 * DRAWN_OPACITY, 1.6 * DRAWN_OPACITY  # after rounding
_COLOUR_STEP = 0.0275  # twice what formats move constant colours by, and a little
_SCALE_STEP = 0.08  # the same for log scales
_MIN_LOG_SCALE = -9.9  # of `.spz`, whose least is -10
_SMALL = -9.0  # log scales of the smallest, beside that of the cube
# x, y and z are below it, so that w is never smaller. A step is 16 of `.spz`, which packs that better.
_TURNS_REACH = 256 / 511 * 0.5**0.5
_FARTHEST, _MAX_SHIFTS = 1 << 12, 500  # steps of log scales: that are looked at, and that are tried


def is_candidate(model: Gaussians) -> Flags:
    """[N] which Gaussians are as faint as appended ones."""
    opacities = model.opacities.detach().cpu().numpy()
    found: Flags = (opacities > _FAINTEST) & (opacities < _STRONGEST)
    for values in (model.means, model.quats, model.log_scales, model.sh):
        found &= np.isfinite(values.detach().cpu().numpy()).reshape(len(found), -1).all(axis=1)
    return found


def is_appended(model: Gaussians) -> Tensor:
    """[N] which Gaussians were appended to a model that no format has rounded since.

    They have one opacity, which others have to the last bit by chance only: once in millions.
    """
    return model.opacity_logits == float(np.float32(_LOGIT))


def own_frame(model: Gaussians) -> Similarity:
    """From the own frame to the world: its unit cube becomes about as large as most of the model.

    Size and place are such that coordinates of lattice points have few digits, which `.spz` packs better.
    """
    means = doubles(model.means)
    means = means[np.isfinite(means).all(axis=1)]
    low, high = np.quantile(means, [0.05, 0.95], axis=0) if len(means) else np.zeros((2, 3))
    size = float((high - low).max())
    size = 2.0 ** round(math.log2(size)) if 0 < size < math.inf else 1.0
    step = size / 2**POSITION_BITS
    return Similarity(size, translation=torch.from_numpy(np.rint((low + high - size) / 2 / step) * step))


def check_place(to_world: Similarity) -> None:
    """Raise UsageError if float32 does not hold positions in that frame to a quarter of a step."""
    corner = to_world.translation.numpy()
    step = to_world.scale / 2**POSITION_BITS
    if float(np.spacing(np.float32(np.abs(corner).max()))) > step / 4:
        x, y, z = corner
        away = f"{x:.9g},{y:.9g},{-z:.9g}"  # its axes are turned by half a turn about z
        raise UsageError(
            "the cover is too far from the origin for the single precision of its file: move it, e.g. with "
            f"`splat-transform IN -t {away} OUT.ply`"
        )


def in_order(words: Bits) -> Bits:
    """`words` by the z of their turns, then y, then x: `.spz` packs runs of equal rotations."""
    turns = words[:, -3 * TURN_BITS :].reshape(-1, 3, TURN_BITS)[:, ::-1]  # the highest bit of z first
    return words[np.lexsort(turns.reshape(len(words), -1).T[::-1])]


def to_gaussians(words: Bits, to_world: Similarity, sh_degree: int) -> Gaussians:
    """N Gaussians of words [N, WORD_BITS]; `to_world`: of `own_frame`."""
    least_log_scale = max(_SMALL, _MIN_LOG_SCALE - math.log(to_world.scale))
    fields = _split(words)
    colours = (fields[0] + 0.5) * _COLOUR_STEP - _COLOUR_STEP * 2 ** (COLOUR_BITS - 1)
    scales = fields[1] * _SCALE_STEP + least_log_scale
    positions = (fields[2] + 0.5) / 2**POSITION_BITS
    parts = (fields[3] + 0.5) / 2**TURN_BITS * 2 * _TURNS_REACH - _TURNS_REACH
    w = np.sqrt(1 - np.square(parts).sum(axis=1, keepdims=True))
    sh = np.zeros((len(words), (sh_degree + 1) ** 2, 3))
    sh[:, 0] = colours
    logits = np.full(len(words), _LOGIT)
    numbers = (positions, np.concatenate([w, parts], axis=1), scales, logits, sh)
    own = Gaussians(*(torch.from_numpy(each).float() for each in numbers))
    return to_world.apply_gaussians(own)


def colours_of(model: Gaussians) -> Integers:
    """[N, 3] the nearest lattice points of colours."""
    colours = doubles(model.sh[:, 0])
    return _nearest(colours / _COLOUR_STEP + 2 ** (COLOUR_BITS - 1) - 0.5, COLOUR_BITS)


def scale_steps(model: Gaussians) -> Doubles:
    """[N, 3] log scales in steps of their lattice, which lies anywhere: see `likely_shifts`."""
    return doubles(model.log_scales) / _SCALE_STEP


def scales_at(steps: Doubles, shift: float) -> Integers:
    """[N, 3] the nearest lattice points of log scales, of a lattice that begins at `shift`."""
    return _nearest(steps - shift, SCALE_BITS)


def likely_shifts(steps: Doubles) -> list[float]:
    """Where the lattice may begin if most of the log scales lie on it, the likeliest first.

    A model that was scaled has all log scales shifted by one number: the lattice is where they lie.
    """
    phase = float(np.angle(np.exp(2j * np.pi * steps).mean())) / (2 * np.pi)
    whole = np.rint(steps - phase).clip(-_FARTHEST, _FARTHEST).astype(np.int64)
    found = np.bincount((whole + _FARTHEST).ravel(), minlength=2 * _FARTHEST)
    inside = np.convolve(found, np.ones(2**SCALE_BITS, np.int64))  # at i: those in the levels up to i
    best = int(inside.argmax()) - 2**SCALE_BITS + 1 - _FARTHEST
    return [best + phase + each for each in (0, 1, -1, 2, -2)]


def all_shifts(steps: Doubles) -> Doubles:
    """[S] where the lattice may begin if only some of the log scales lie on it."""
    low, high = np.quantile(steps.clip(-_FARTHEST, _FARTHEST), [0.01, 0.99])
    most = min(high - 2 ** (SCALE_BITS - 2), low + _MAX_SHIFTS)
    return np.arange(low - 2 ** (SCALE_BITS - 1), max(most, low), 0.25)


def in_own_frame(model: Gaussians, to_own: Similarity) -> Integers:
    """[N, 6] the nearest lattice points of positions and turns; `to_own`: from the world."""
    own = to_own.apply_gaussians(model.with_sh_degree(0))
    positions = own.means.double().numpy() * 2**POSITION_BITS - 0.5
    parts = with_largest_w(own.quats.double().numpy())[:, 1:]
    turns = (parts + _TURNS_REACH) / (2 * _TURNS_REACH) * 2**TURN_BITS - 0.5
    return np.concatenate([_nearest(positions, POSITION_BITS), _nearest(turns, TURN_BITS)], axis=1)


def joined(colours: Integers, scales: Integers, others: Integers) -> Bits:
    """[N, WORD_BITS] words of colours and scales [N, 3] and of positions and turns [N, 6]."""
    parts = [
        (colours, COLOUR_BITS),
        (scales, SCALE_BITS),
        (others[:, :3], POSITION_BITS),
        (others[:, 3:], TURN_BITS),
    ]
    bits = [bits_of(each[:, axis].astype(np.uint64), width) for each, width in parts for axis in range(3)]
    return np.concatenate(bits, axis=1)


def invariants_of(colours: Integers, scales: Integers) -> Words:
    """[N] the first INVARIANT_BITS of words of colours and scales [N, 3]."""
    of_colours = colours @ (1 << COLOUR_BITS * np.arange(3)[::-1])
    of_scales = scales @ (1 << SCALE_BITS * np.arange(3)[::-1])
    return (of_colours << 3 * SCALE_BITS | of_scales).astype(np.uint64)


def number(bits: Bits) -> Words:
    """[N] the numbers of bits [N, B], B at most 64, the highest bit first."""
    powers = np.uint64(1) << np.arange(bits.shape[1], dtype=np.uint64)[::-1]
    return bits.astype(np.uint64) @ powers


def bits_of(numbers: Words, count: int) -> Bits:
    """[N, count] the inverse of `number`."""
    shifts = np.arange(count, dtype=np.uint64)[::-1]
    return (numbers[:, None] >> shifts & np.uint64(1)).astype(np.uint8)


def _split(words: Bits) -> list[Doubles]:
    """Colours, scales, positions and turns [N, 3] each."""
    fields, at = [], 0
    for width in (COLOUR_BITS, SCALE_BITS, POSITION_BITS, TURN_BITS):
        own = words[:, at : at + 3 * width].reshape(-1, 3, width)
        fields.append(own.astype(np.float64) @ 2.0 ** np.arange(width)[::-1])
        at += 3 * width
    return fields


def _nearest(steps: Doubles, bits: int) -> Integers:
    return np.rint(steps).clip(0, 2**bits - 1).astype(np.int64)
