"""Levels changed as little as can be until their last bits are the wanted ones.

Matching (Sharp 2001), not overwriting: overwriting moves even levels up and odd ones down only, which makes
pairs of them equally frequent and is what the attacks of Westfeld and Pfitzmann (1999) and of Fridrich et al.
(2001) find. Where the numbers before rounding are known, the nearest level to these is taken, which halves
what writing costs (perturbed quantisation, Fridrich, Goljan and Soukal 2004).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from keyss.channels.codes.fields import Doubles, Levels
from keyss.core.gaussians import Gaussians
from keyss.files.formats.common import Codes, arrays_of, unit
from keyss.files.formats.compressed_ply import CHUNK, CompressedPlyCodes
from keyss.files.formats.sog import SogCodes
from keyss.files.formats.spz import SpzCodes


def matched(levels: Levels, residues: Levels, bits: Levels, near: Doubles) -> Levels:
    """[N] the levels with `residues` modulo 2^bits that are nearest to `near`.

    `near`: the numbers that were rounded to `levels`, or the levels with less than half a level added at
    random, so that of two equally near ones either is taken.
    """
    step = 1 << bits
    target = near.clip(levels - 0.5, levels + 0.5)
    return (residues + step * ((target - residues) / step).round()).astype("int32")


def reach(bits: Levels) -> Levels:
    """[N] by how many levels `matched` moves one at most."""
    return (1 << bits >> 1) + 1


def unrounded(model: Gaussians, codes: Codes) -> dict[str, Doubles]:
    """By field the levels [N, C] of the `model` that was quantised to `codes`, Gaussian by Gaussian."""
    found = _FORMATS[type(codes)](model, codes)
    return {name: np.nan_to_num(each) for name, each in found.items()}


def _spz(model: Gaussians, codes: SpzCodes) -> dict[str, Doubles]:
    means, quats, *_ = arrays_of(model)
    xyz = _others(np.roll(unit(quats) * np.array([1, 1, -1, -1]), -1, axis=1), codes.largest)
    steps = 511 * np.sqrt(2)
    return {
        "positions": np.ldexp(means.astype(np.float64), codes.fractional_bits) * np.array([1, -1, -1]),
        "rotations": (xyz + 1) * 127.5 if codes.version == 2 else xyz * steps,
    }


def _sog(model: Gaussians, codes: SogCodes) -> dict[str, Doubles]:
    means, quats, *_ = arrays_of(model)
    logs = np.copysign(np.log1p(np.abs(means.astype(np.float64))), means)
    extent = np.where(codes.maxs > codes.mins, codes.maxs - codes.mins, 1.0)
    return {
        "positions": (logs - codes.mins) / extent * 65535,
        "rotations": (_others(unit(quats), codes.largest) * np.sqrt(2) + 1) / 2 * 255,
    }


def _compressed_ply(model: Gaussians, codes: CompressedPlyCodes) -> dict[str, Doubles]:
    _, quats, log_scales, *_ = arrays_of(model)
    ends = codes.bounds.astype(np.float64).repeat(CHUNK, axis=0)[: len(codes)].reshape(-1, 3, 2, 3)
    low, high = ends[:, 1, 0], ends[:, 1, 1]
    return {
        "scales": (log_scales - low) / np.where(high > low, high - low, 1.0) * np.array([2047, 1023, 2047]),
        "rotations": (_others(unit(quats), codes.largest) * np.sqrt(0.5) + 0.5) * 1023,
    }


_FORMATS: dict[type[Codes], Callable[[Gaussians, Any], dict[str, Doubles]]] = {
    SpzCodes: _spz,
    SogCodes: _sog,
    CompressedPlyCodes: _compressed_ply,
}


def _others(quats: Doubles, largest: npt.NDArray[np.uint8]) -> Doubles:
    """[N, 3] the parts of quaternions [N, 4] that are not `largest`, which is made positive."""
    index = largest[:, None].astype(np.int64)
    sign = np.where(np.take_along_axis(quats, index, 1) < 0, -1.0, 1.0)
    rest = np.arange(3) + (np.arange(3) >= index)
    return np.take_along_axis(quats * sign, rest, 1)
