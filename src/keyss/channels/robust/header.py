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
from keyss.channels.robust.lattice import COLUMNS, SPACINGS, Lattice, rank
from keyss.channels.robust.salts import SALTS
from keyss.keys.derivation import expand

DATA_KEY_BYTES = 16
BITS = 1100  # of the code of a header
UNNOTICED = 2  # secrets whose headers are always there, if only as noise
CLASSES = 8  # of carriers, of which a payload has some
LATTICE = Lattice(40, SPACINGS[0])  # of headers
_LEAST_BITS = 2  # of a number that holds some of a header
_CHECK_BYTES = 2
_BYTES = DATA_KEY_BYTES + 3 + _CHECK_BYTES
_ROUNDS = 16
# How a header is looked at: bits (of BITS), those of them that are likely to hold what was written, how
# likely that is, and how likely for the rest. Where Gaussians were lost, others have taken their places, at
# the end; where two models were put together, half of the places are the other's.
_VIEWS = ((1.0, 1.0, 0.85, 0.85), (1.0, 0.73, 0.85, 0.1), (1.0, 0.48, 0.85, 0.05), (2.0, 2.0, 0.45, 0.45))
_PUBLIC = hashlib.sha256(b"keyss/v1/robust-class").digest()


@dataclass(frozen=True)
class Header:
    """How a payload is read."""

    data_key: bytes
    level: int  # of the lattice
    spacing: int  # index into SPACINGS
    classes: int  # a bit for each of CLASSES
    bucket: int  # see `bucket_bytes`

    @property
    def lattice(self) -> Lattice:
        return Lattice(self.level, SPACINGS[self.spacing])

    def pack(self, secret: bytes) -> Bits:
        """The bits of a header, encrypted under `secret`, which no other header has."""
        plain = self.data_key + bytes([self.level << 2 | self.spacing, self.classes, self.bucket])
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
        if not classes:
            return None
        return Header(plain[:DATA_KEY_BYTES], lattice >> 2, lattice & 3, classes, bucket)


def write_header(header: Header, secret: bytes, carriers: Carriers) -> Doubles:
    """[P, 2] new values of the carriers that `places` names."""
    seeds = LATTICE.seeds(secret, carriers)
    return LATTICE.write(secret, carriers, _fountain().encode(header.pack(secret), seeds))


def read_header(secret: bytes, carriers: Carriers, thorough: bool = True) -> Header | None:
    """The header of this secret, if there is one. `thorough`: even where half is lost or foreign."""
    for window, safe, trust, rest in _VIEWS if thorough else _VIEWS[:1]:
        rows, namesakes, before = places(secret, carriers, window * BITS)
        if not len(rows):
            return None
        own = carriers[rows]
        sure = np.where(before < safe * BITS, trust, rest)
        doubt = 1 - sure * (1 - own.doubt) / namesakes
        ratios, seeds = LATTICE.read(secret, own, doubt), LATTICE.seeds(secret, own)
        bits, _ = _fountain().decode(seeds, ratios, _ROUNDS)
        header = Header.unpack(bits, secret)
        if header is not None:
            return header
    return None


def places(
    secret: bytes, carriers: Carriers, bits: float = BITS
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], Doubles]:
    """[P] which carriers hold the header of `secret`, [P] how many share a name, [P] bits that come before.

    Those whose names have the least keyed hashes, as many as hold `bits` bits. Of carriers with one name one
    counts.
    """
    some = np.flatnonzero(LATTICE.bits(carriers) >= _LEAST_BITS)
    ranks = rank(secret, "places", carriers.names[some])
    most = int(2 * bits)  # of them are enough, unless most names are equal
    if len(ranks) > most:
        least = np.argpartition(ranks, most)[:most]
        some, ranks = some[least], ranks[least]
    some = some[np.argsort(ranks, kind="stable")]
    _, first, order, namesakes = np.unique(
        np.sort(ranks), return_index=True, return_inverse=True, return_counts=True
    )
    each = COLUMNS * LATTICE.bits(carriers[some[first]])
    before = np.cumsum(each) - each
    own = before[order] < bits
    return some[own], namesakes[order][own], before[order][own].astype(np.float64)


def header_share(carriers: Carriers) -> float:
    """Of carriers, those that the headers of one secret take."""
    bits = LATTICE.bits(carriers)
    return min(1.0, SALTS * BITS / max(1.0, COLUMNS * float(bits.sum())))


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
