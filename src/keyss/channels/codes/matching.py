"""Levels changed as little as can be until their last bits are the wanted ones.

Matching (Sharp 2001), not overwriting: overwriting moves even levels up and odd ones down only, which makes
pairs of them equally frequent and is what the attacks of Westfeld and Pfitzmann (1999) and of Fridrich et al.
(2001) find. Where the numbers before rounding are known, the nearest level to these is taken.
"""

from __future__ import annotations

from keyss.channels.codes.fields import Doubles, Levels


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
