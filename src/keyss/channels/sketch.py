"""A sketch of the Gaussians of a model, by which a reader detects foreign ones: added or changed later.

The first bits of a Bloom filter (Bloom 1970) of N bits with one keyed hash, for a model of N Gaussians. The
bits of its own Gaussians are set, however many are lost. A foreign Gaussian hits an unset bit with
probability bits / (e N).
"""

from __future__ import annotations

import numpy as np

from keyss.channels.mixing import encrypted_blocks
from keyss.core.arrays import Bytes, Integers
from keyss.keys.derivation import expand

SKETCH_BYTES = 32  # in low bits


def sketch(secret: bytes, ids: Bytes, size: int = SKETCH_BYTES) -> bytes:
    """A sketch of `size` bytes of Gaussians with `ids` [N, 16]."""
    bits = np.zeros(8 * size, np.uint8)
    bits[_places(secret, ids, len(ids), len(bits))] = 1
    return np.packbits(bits, bitorder="little").tobytes()


def foreign(secret: bytes, ids: Bytes, own: bytes, gaussians: int) -> int:
    """Estimated number of `ids` [M, 16] foreign to the sketch `own` of `gaussians` Gaussians."""
    bits = np.unpackbits(np.frombuffer(own, np.uint8), bitorder="little")
    unset = bits[_places(secret, ids, gaussians, len(bits))] == 0
    ways = int((bits[:gaussians] == 0).sum())
    return min(len(ids), round(int(unset.sum()) * gaussians / max(1, ways)))


def _places(secret: bytes, ids: Bytes, count: int, kept: int) -> Integers:
    """Bit positions below `kept` that the Gaussians hash to, of `count` positions."""
    hashed = encrypted_blocks(expand(secret, "sketch", 32), ids)[:, :4].copy().view("<u4")[:, 0]
    places = hashed.astype(np.int64) % max(1, count)
    return places[places < kept]
