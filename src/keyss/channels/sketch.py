"""A sketch of the Gaussians of a model, in which a reader sees Gaussians of other models.

A Bloom filter (Bloom 1970) with one hash, under a secret key, of every Gaussian's identity. Of as many bits
as there are Gaussians, only some are kept. The model's own Gaussians find their bits set, whichever are lost;
another one sees a bit that is not set with the probability bits / (e N), of N Gaussians.
"""

from __future__ import annotations

import numpy as np

from keyss.channels.mixing import encrypted_blocks
from keyss.core.arrays import Bytes, Integers
from keyss.keys.derivation import expand

SKETCH_BYTES = 32  # in low bits


def sketch(secret: bytes, names: Bytes, size: int = SKETCH_BYTES) -> bytes:
    """`size` bytes of the Gaussians with the identities `names` [N, 16]."""
    bits = np.zeros(8 * size, np.uint8)
    bits[_places(secret, names, len(names), len(bits))] = 1
    return np.packbits(bits, bitorder="little").tobytes()


def foreign(secret: bytes, names: Bytes, own: bytes, gaussians: int) -> int:
    """About how many Gaussians are not among the `gaussians` of the sketch `own`; 0 if none was seen."""
    bits = np.unpackbits(np.frombuffer(own, np.uint8), bitorder="little")
    unset = bits[_places(secret, names, gaussians, len(bits))] == 0
    ways = int((bits[:gaussians] == 0).sum())
    return min(len(names), round(int(unset.sum()) * gaussians / max(1, ways)))


def _places(secret: bytes, names: Bytes, count: int, kept: int) -> Integers:
    """Those of the places below `count` that are kept, of the Gaussians that have one."""
    hashed = encrypted_blocks(expand(secret, "sketch", 32), names)[:, :4].copy().view("<u4")[:, 0]
    places = hashed.astype(np.int64) % max(1, count)
    return places[places < kept]
