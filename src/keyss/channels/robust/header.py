"""What a key opens first: a data key and how to read the rest, in a few Gaussians that the key chooses."""

from __future__ import annotations

import hashlib
import hmac
from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt

from keyss.channels.robust.carriers import Carriers, Doubles
from keyss.channels.robust.fountain import Bits, Fountain
from keyss.channels.robust.lattice import Lattice, rank
from keyss.keys.derivation import expand

DATA_KEY_BYTES = 16
CARRIERS = 110  # of a header
CLASSES = 8  # of carriers, of which a payload has some
# Bits of green and blue, the cheapest first, and distances between points of the lattice.
LEVELS = ((1, 0), (1, 1), (2, 1), (2, 2), (3, 2), (3, 3), (4, 3), (4, 4))
SPACINGS = (0.0275, 0.04, 0.06, 0.09)
LATTICE = Lattice((3, 3), SPACINGS[0])  # of headers
_CHECK_BYTES = 2
_BYTES = DATA_KEY_BYTES + 3 + _CHECK_BYTES
_ROUNDS = 20
_SAFE = 0.7  # of the places: what is there is what was written, if no more than a quarter was lost
_PUBLIC = hashlib.sha256(b"keyss/v1/robust-class").digest()


@dataclass(frozen=True)
class Header:
    """How a payload is read."""

    data_key: bytes
    level: int  # index into LEVELS
    spacing: int  # index into SPACINGS
    classes: int  # a bit for each of CLASSES
    bucket: int  # see `bucket_bytes`

    @property
    def lattice(self) -> Lattice:
        return Lattice(LEVELS[self.level], SPACINGS[self.spacing])

    def pack(self, secret: bytes) -> Bits:
        """The bits of a header, encrypted under `secret`, which no other header has."""
        plain = self.data_key + bytes([self.level << 4 | self.spacing, self.classes, self.bucket])
        data = np.frombuffer(plain + _check(secret, plain), np.uint8) ^ _stream(secret)
        return np.unpackbits(data)

    @staticmethod
    def unpack(bits: Bits, secret: bytes) -> Header | None:
        """None where it is not one: by chance one of 2^16 is, and opens nothing."""
        data = (np.packbits(bits) ^ _stream(secret)).tobytes()
        plain, check = data[:-_CHECK_BYTES], data[-_CHECK_BYTES:]
        lattice, classes, bucket = plain[DATA_KEY_BYTES:]
        if not hmac.compare_digest(check, _check(secret, plain)):
            return None
        if lattice >> 4 >= len(LEVELS) or lattice & 15 >= len(SPACINGS) or not classes:
            return None
        return Header(plain[:DATA_KEY_BYTES], lattice >> 4, lattice & 15, classes, bucket)


def write_header(header: Header, secret: bytes, carriers: Carriers) -> Doubles:
    """[P, 2] new values of the carriers that `places` names."""
    seeds = LATTICE.seeds(secret, carriers)
    code = _fountain().encode(header.pack(secret), seeds.ravel()).reshape(seeds.shape)
    return LATTICE.write(secret, carriers, code)


def read_header(secret: bytes, carriers: Carriers) -> Header | None:
    """The header of this secret, if there is one."""
    rows, order = places(secret, carriers)
    if not len(rows):
        return None
    own = carriers[rows]
    # Where Gaussians were lost, others have taken their places, at the end.
    safe = np.where(order < _SAFE * CARRIERS, 0.92, 0.7)
    doubt = 1 - safe * (1 - own.doubt) / np.bincount(order)[order]
    ratios, seeds = LATTICE.read(secret, own, doubt), LATTICE.seeds(secret, own)
    bits, _ = _fountain().decode(seeds.ravel(), ratios.ravel(), _ROUNDS)
    return Header.unpack(bits, secret)


def places(secret: bytes, carriers: Carriers) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """[P] which carriers hold the header of `secret`, and [P] the place of their names, below CARRIERS.

    The names with the least keyed hashes. Carriers with one name have one place.
    """
    ranks = rank(secret, "places", carriers.names)
    most = 8 * CARRIERS  # which are enough, unless most names are equal
    some = np.argpartition(ranks, most)[:most] if len(ranks) > most else np.arange(len(ranks))
    _, order = np.unique(ranks[some], return_inverse=True)
    own = np.flatnonzero(order < CARRIERS)
    own = own[np.argsort(order[own], kind="stable")]
    return some[own], order[own]


def class_of(carriers: Carriers) -> npt.NDArray[np.int64]:
    """[C] the class of each carrier, below CLASSES: a public hash of its name."""
    return (rank(_PUBLIC, "class", carriers.names) % np.uint64(CLASSES)).astype(np.int64)


def bucket_bytes(bucket: int) -> int:
    """The size that a number of one byte stands for: 32 to 2 million bytes in steps of 3 to 6 %."""
    return (16 + bucket % 16) << (bucket // 16 + 1)


def _check(secret: bytes, plain: bytes) -> bytes:
    return hmac.digest(expand(secret, "robust/check", 32), plain, "sha256")[:_CHECK_BYTES]


def _stream(secret: bytes) -> Bits:
    return np.frombuffer(expand(secret, "robust/header", _BYTES), np.uint8)


@cache
def _fountain() -> Fountain:
    return Fountain.of(8 * _BYTES)
