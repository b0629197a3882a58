"""The Gaussians that serve as the salt of Argon2id, and the salts that they give.

A salt is a hash of one Gaussian, low bits included. These are new random bits for every file, so that two
files of one cover have no salt in common, and carry nothing else. Because Gaussians may be removed there are
several, in an order that embedding leaves as it is: first those without small harmonics and coincidences,
because they are hardly ever left alone (see `usable`), and of these the smallest identities.
"""

from __future__ import annotations

import hashlib

import numpy as np
import numpy.typing as npt

from keyss.channels.low_bits.bits import (
    GEOMETRY,
    QUATS,
    UNIT_TOLERANCE,
    Bytes,
    Flags,
    Layout,
    Words,
    blocks,
    coarse_lengths,
    used_words,
)
from keyss.channels.low_bits.layout import SALTS
from keyss.channels.low_bits.usable import exponents, near_equal
from keyss.core.gaussians import Gaussians
from keyss.keys.derivation import SALT_BYTES

_LABEL = b"keyss/v2/salt"
_MANTISSA = np.uint32((1 << 23) - 1)


def salt_rows(gaussians: Gaussians, names: Bytes, low: Bytes) -> npt.NDArray[np.int64]:
    """[SALTS or less] the Gaussians, the first first, of identities `names` [N, 16] and `low` bits [N, B]."""
    layout = Layout.of(gaussians)
    ranks = np.concatenate([_ranks(used_words(part), layout) for part in blocks(gaussians)])
    keys = ranks << np.uint64(55) | names[:, :8].copy().view(">u8")[:, 0].astype(np.uint64) >> np.uint64(9)
    some = np.argpartition(keys, SALTS - 1)[:SALTS] if len(keys) > SALTS else np.arange(len(keys))
    order = sorted(some.tolist(), key=lambda row: (int(keys[row]), names[row].tobytes(), low[row].tobytes()))
    return np.array(order, np.int64)


def salt(identity: Bytes, low: Bytes) -> bytes:
    """SALT_BYTES of one Gaussian."""
    return hashlib.sha256(_LABEL + identity.tobytes() + low.tobytes()).digest()[:SALT_BYTES]


def _ranks(used: Words, layout: Layout) -> npt.NDArray[np.uint64]:
    """[N] 0 to 511: 256 for what may well be left alone, and less the larger the least harmonic is."""
    chosen = used[:, layout.columns]
    doubtful: Flags = near_equal(used, layout) | (exponents(chosen) == 0).any(axis=1)
    doubtful |= (chosen & _MANTISSA & ~layout.mask[layout.columns] & ~np.uint32(1) == 0).any(axis=1)
    if layout.quats:
        doubtful |= np.abs(coarse_lengths(used[:, QUATS]) - 1) < UNIT_TOLERANCE
    harmonics = used[:, GEOMETRY:] if used.shape[1] > GEOMETRY else chosen
    least = 255 - exponents(harmonics).min(axis=1).astype(np.uint64)
    ranks: npt.NDArray[np.uint64] = doubtful.astype(np.uint64) << np.uint64(8) | least
    return ranks
