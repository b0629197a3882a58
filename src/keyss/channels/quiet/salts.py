"""Salts of Argon2id, and the Gaussians that they are hashes of.

A salt is a hash of one Gaussian and its low bits, which are new random bits for every file and carry nothing
else: no two files of one cover share a salt. There are several salts because Gaussians may be removed. Their
order does not change by embedding: first Gaussians without small harmonics and coincidences, which are rarely
excluded (see `usable`), and among these the smallest IDs.
"""

from __future__ import annotations

import hashlib

import numpy as np
import torch

from keyss.channels.quiet.bits import (
    BLOCK,
    GEOMETRY,
    QUATS,
    UNIT_TOLERANCE,
    Layout,
    coarse_lengths,
    read_low_bits,
    used_words,
)
from keyss.channels.quiet.layout import SALTS
from keyss.channels.quiet.usable import exponents, near_equal
from keyss.core.arrays import Bytes, Integers, Words
from keyss.core.gaussians import Gaussians
from keyss.kernels.parallel import in_blocks
from keyss.keys.derivation import SALT_BYTES

_LABEL = b"keyss/v2/salt"
_MANTISSA = np.uint32((1 << 23) - 1)


def salt_rows(
    gaussians: Gaussians, ids: Bytes, low: Bytes | None = None, layout: Layout | None = None
) -> Integers:
    """Rows of the salts' Gaussians, at most SALTS, in order; `ids` [N, 16], `low` bits [N, B] if known."""
    layout = layout or Layout.of(gaussians)
    ranks = _ranks(gaussians, layout)
    # 9 bits of rank, 55 of the ID.
    keys = ranks << np.uint64(55) | ids[:, :8].copy().view(">u8")[:, 0].astype(np.uint64) >> np.uint64(9)
    best = np.argpartition(keys, SALTS - 1)[:SALTS] if len(keys) > SALTS else np.arange(len(keys))
    bits = read_low_bits(gaussians[torch.from_numpy(best)], layout) if low is None else low[best]
    order = sorted(
        range(len(best)), key=lambda i: (ranks[best[i]], ids[best[i]].tobytes(), bits[i].tobytes())
    )
    return best[order]


def salt(carrier_id: Bytes, low: Bytes) -> bytes:
    """The salt of one carrier: SALT_BYTES."""
    return hashlib.sha256(_LABEL + carrier_id.tobytes() + low.tobytes()).digest()[:SALT_BYTES]


def _ranks(gaussians: Gaussians, layout: Layout) -> Words:
    """[N] 0 to 511, lower first: 256 if doubtful, plus 255 minus the exponent of the least harmonic."""
    columns = layout.columns
    stays = layout.mask[columns] | np.uint32(1)

    def ranked(start: int, stop: int) -> Words:
        used = used_words(gaussians[start:stop])
        chosen = used[:, columns]
        large = exponents(chosen)
        doubtful = ((large == 0) | (chosen & _MANTISSA & ~stays == 0)).any(axis=1) | near_equal(used, layout)
        if layout.quats:
            doubtful |= np.abs(coarse_lengths(used[:, QUATS]) - 1) < UNIT_TOLERANCE
        harmonics = exponents(used[:, GEOMETRY:]) if used.shape[1] > GEOMETRY else large
        rank: Words = (255 - harmonics.min(axis=1) + 256 * doubtful).astype(np.uint64)
        return rank

    return np.concatenate([np.zeros(0, np.uint64), *in_blocks(ranked, len(gaussians), BLOCK)])
