"""Siblings: Gaussians that density control split, whose constant colours predict low bits of harmonics.

Adam's steps do not depend on the size of a gradient. While one of two siblings is seen alone, or both in one
direction, all harmonics x of a colour move apart by the same amount, and its constant colour c, whose rate is
20 times as large in common trainers, by 20 times as much:

    |x(i) - x(j)| = |c(i) - c(j)| / 20

to a few units in the last place. Constant colours are never written. Siblings are near neighbours; where they
moved in few directions, a part of their harmonics agrees. By chance two or three harmonics of a pair do.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from keyss.channels.quiet.bits import SH_BITS, UNUSED_BITS
from keyss.core.arrays import Flags, doubles
from keyss.core.gaussians import Gaussians
from keyss.core.neighbours import nearest_neighbours
from keyss.kernels.jit import kernel
from keyss.kernels.parallel import in_blocks

RATE_RATIO = 20  # learning rate of constant colours / harmonics
_NEIGHBOURS = 12  # siblings were among the nearest 10 in models of 20,000 to 200,000 Gaussians
_SHARE = 3  # a third of the harmonics of a colour agree, and at least three
_ROWS = 1 << 12
_CELL = np.uint32((1 << SH_BITS + UNUSED_BITS) - 1)
_CELL_SHARE = np.float32(2.0 ** (SH_BITS + UNUSED_BITS - 23))  # cell width / number, up to a factor of 2


def find_siblings(gaussians: Gaussians, among: Flags) -> Flags:
    """Mask [N] of the siblings `among` [N], found by bits that embedding never changes."""
    apart, rows = np.zeros(len(gaussians), bool), np.flatnonzero(among)
    if len(gaussians) < 2 or not gaussians.sh_degree:
        return apart
    means = np.nan_to_num(doubles(gaussians.means), posinf=0, neginf=0)
    near = nearest_neighbours(means[rows], min(_NEIGHBOURS + 1, len(means)), means)[1]
    sh = gaussians.sh.detach().to("cpu", torch.float32).transpose(1, 2).contiguous().numpy()
    constant = sh[:, :, 0] / np.float32(RATE_RATIO)
    middles = (sh[:, :, 1:].view(np.uint32) & ~_CELL | (_CELL + 1) >> 1).view(np.float32)
    needed = max(_SHARE, -(-middles.shape[2] // _SHARE))

    def mark(start: int, stop: int) -> None:
        _mark(rows[start:stop], near[start:stop], constant, middles, needed, apart)

    in_blocks(mark, len(rows), _ROWS)
    return apart & among


@kernel
def _mark(rows: Any, near: Any, constant: Any, middles: Any, needed: int, apart: Any) -> None:
    """Set `apart` for both Gaussians of pairs of `rows` [R] and their neighbours `near` [R, K]."""
    for row in range(len(rows)):
        one = rows[row]
        for other in near[row]:
            for colour in range(3):
                steps = abs(constant[one, colour] - constant[other, colour])
                agree = np.float32(0)
                for at in range(middles.shape[2]):
                    own, its = middles[one, colour, at], middles[other, colour, at]
                    cell = max(abs(own), abs(its)) * _CELL_SHARE
                    agree += np.float32(1 if abs(abs(own - its) - steps) <= cell else 0)
                if agree >= needed and other != one:
                    apart[one] = apart[other] = True
