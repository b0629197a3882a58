"""A sketch of the Gaussians of a model, in which a reader sees Gaussians of other models.

A Bloom filter (Bloom 1970) with one hash, under the data key, of every Gaussian's identity; only the first
BITS of as many places as there are Gaussians are kept. A model's own Gaussians find their bits set, whichever
are lost, and another one sees a bit that is not set with the probability BITS / (e N) of N Gaussians.
"""

from __future__ import annotations

import numpy as np

from keyss.channels.mixing import encrypted_blocks
from keyss.core.arrays import Bytes, Integers
from keyss.keys.derivation import expand

BITS = 256
SKETCH_BYTES = BITS // 8


def sketch(data_key: bytes, names: Bytes) -> bytes:
    """SKETCH_BYTES of the Gaussians with the identities `names` [N, 16]."""
    bits = np.zeros(BITS, np.uint8)
    bits[_places(data_key, names, len(names))] = 1
    return np.packbits(bits, bitorder="little").tobytes()


def foreign(data_key: bytes, names: Bytes, own: bytes, gaussians: int) -> int:
    """About how many Gaussians are not among the `gaussians` of the sketch `own`; 0 if none was seen."""
    bits = np.unpackbits(np.frombuffer(own, np.uint8), bitorder="little")[:gaussians]
    unset = bits[_places(data_key, names, gaussians)] == 0
    return min(len(names), round(int(unset.sum()) * gaussians / max(1, int((bits == 0).sum()))))


def _places(data_key: bytes, names: Bytes, count: int) -> Integers:
    """Those of the places below `count` that are kept, of the Gaussians that have one."""
    hashed = encrypted_blocks(expand(data_key, "sketch", 32), names)[:, :4].copy().view("<u4")[:, 0]
    places = hashed.astype(np.int64) % max(1, count)
    return places[places < BITS]
