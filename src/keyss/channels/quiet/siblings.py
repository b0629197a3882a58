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
from keyss.files.formats.common import morton_order
from keyss.kernels.jit import kernel
from keyss.kernels.parallel import in_blocks

RATE_RATIO = 20  # learning rate of constant colours / harmonics
_NEIGHBOURS = 12  # siblings were among the nearest 10 in models of 20,000 to 200,000 Gaussians
_SHARE = 3  # a third of the harmonics of a colour agree, and at least three
_ROWS = 1 << 12
_CELL = np.uint32((1 << SH_BITS + UNUSED_BITS) - 1)
_CELL_SHARE = np.float32(2.0 ** (SH_BITS + UNUSED_BITS - 23))  # cell width / number, up to a factor of 2


def find_siblings(gaussians: Gaussians, among: Flags) -> Flags:
    """[N] which Gaussians `among` [N] moved away from a neighbour by equal steps, as fixed bits tell."""
    if len(gaussians) < 2 or not gaussians.sh_degree:
        return np.zeros(len(gaussians), bool)
    means = np.nan_to_num(doubles(gaussians.means), posinf=0, neginf=0)
    order = morton_order(means.astype(np.float32))  # neighbours are near in memory, too
    means, rows = means[order], np.flatnonzero(among[order])
    near = nearest_neighbours(means[rows], min(_NEIGHBOURS + 1, len(means)), means)[1]
    sh = gaussians.sh.detach().to("cpu", torch.float32).numpy()[order].transpose(0, 2, 1)
    middles = np.ascontiguousarray(sh.view(np.uint32) & ~_CELL | (_CELL + 1) >> 1).view(np.float32)
    middles[:, :, 0] = sh[:, :, 0] / np.float32(RATE_RATIO)
    needed = 1 + max(_SHARE, -(-(middles.shape[2] - 1) // _SHARE))
    apart = np.zeros(len(means), bool)

    def mark(start: int, stop: int) -> None:
        _mark(rows[start:stop], near[start:stop], middles, needed, apart)

    in_blocks(mark, len(rows), _ROWS)
    siblings = np.zeros(len(means), bool)
    siblings[order] = apart
    return siblings & among


@kernel
def _mark(rows: Any, near: Any, middles: Any, needed: int, apart: Any) -> None:
    """Set `apart` for both Gaussians of pairs of `rows` [R] and their neighbours `near` [R, K].

    `middles` [N, 3, C]: the first harmonic is the constant one, by the ratio of rates; it always agrees.
    """
    for row in range(len(rows)):
        one = rows[row]
        for other in near[row]:
            if other == one or (apart[one] and apart[other]):
                continue
            for colour in range(3):
                own, its = middles[one, colour], middles[other, colour]
                steps = abs(own[0] - its[0])
                agree = np.float32(0)
                for at in range(len(own)):
                    cell = max(abs(own[at]), abs(its[at])) * _CELL_SHARE
                    agree += np.float32(1 if abs(abs(own[at] - its[at]) - steps) <= cell else 0)
                if agree >= needed:
                    apart[one] = apart[other] = True
