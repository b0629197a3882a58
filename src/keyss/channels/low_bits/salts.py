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

from keyss.channels.low_bits import kernels
from keyss.channels.low_bits.bits import KERNEL_BLOCK, UNIT_TOLERANCE, Bytes, Layout, words_of
from keyss.channels.low_bits.layout import SALTS
from keyss.core.gaussians import Gaussians
from keyss.keys.derivation import SALT_BYTES
from keyss.rendering.cpu.parallel import in_blocks

_LABEL = b"keyss/v2/salt"


def salt_rows(
    gaussians: Gaussians, names: Bytes, low: Bytes, layout: Layout | None = None
) -> npt.NDArray[np.int64]:
    """[SALTS or less] the Gaussians, the first first, of identities `names` [N, 16] and `low` bits [N, B]."""
    ranks = _ranks(gaussians, layout or Layout.of(gaussians))
    keys = ranks << np.uint64(55) | names[:, :8].copy().view(">u8")[:, 0].astype(np.uint64) >> np.uint64(9)
    some = np.argpartition(keys, SALTS - 1)[:SALTS] if len(keys) > SALTS else np.arange(len(keys))
    order = sorted(some.tolist(), key=lambda row: (int(keys[row]), names[row].tobytes(), low[row].tobytes()))
    return np.array(order, np.int64)


def salt(identity: Bytes, low: Bytes) -> bytes:
    """SALT_BYTES of one Gaussian."""
    return hashlib.sha256(_LABEL + identity.tobytes() + low.tobytes()).digest()[:SALT_BYTES]


def _ranks(gaussians: Gaussians, layout: Layout) -> npt.NDArray[np.uint64]:
    """[N] 0 to 511: 256 for what may well be left alone, and less the larger the least harmonic is."""
    _, *fields = words_of(gaussians)
    ranks = np.empty(len(gaussians), np.uint64)
    in_blocks(
        lambda start, stop: kernels.ranks(
            start,
            stop,
            *fields,
            layout.mask,
            layout.shifts,
            layout.quats,
            UNIT_TOLERANCE,
            ranks,
        ),
        len(gaussians),
        KERNEL_BLOCK,
    )
    return ranks
