"""The Gaussians that serve as the salt of Argon2id, and the salts that they give.

A salt is a hash of one Gaussian, low bits included. These are new random bits for every file, so that two
files of one cover have no salt in common, and carry nothing else. Because Gaussians may be removed there are
several, in an order that embedding leaves as it is: first those without small harmonics and coincidences,
because they are hardly ever left alone (see `usable`), and of these the smallest identities.
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
    gaussians: Gaussians, names: Bytes, low: Bytes | None = None, layout: Layout | None = None
) -> Integers:
    """[SALTS or less] the Gaussians, the first first, of identities `names` [N, 16].

    `low` [N, B]: their low bits, where they are known.
    """
    layout = layout or Layout.of(gaussians)
    ranks = _ranks(gaussians, layout)
    # 9 bits of rank, 55 of the identity.
    keys = ranks << np.uint64(55) | names[:, :8].copy().view(">u8")[:, 0].astype(np.uint64) >> np.uint64(9)
    best = np.argpartition(keys, SALTS - 1)[:SALTS] if len(keys) > SALTS else np.arange(len(keys))
    bits = read_low_bits(gaussians[torch.from_numpy(best)], layout) if low is None else low[best]
    order = sorted(
        range(len(best)), key=lambda i: (ranks[best[i]], names[best[i]].tobytes(), bits[i].tobytes())
    )
    return best[order]


def salt(identity: Bytes, low: Bytes) -> bytes:
    """SALT_BYTES of one Gaussian."""
    return hashlib.sha256(_LABEL + identity.tobytes() + low.tobytes()).digest()[:SALT_BYTES]


def _ranks(gaussians: Gaussians, layout: Layout) -> Words:
    """[N] 0 to 511: 256 for what may well be left alone, and less the larger the least harmonic is."""
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
