"""The header, on which a key is tried first: how to read the rest, in a few Gaussians that the key chooses.

There is a *header* under each of a few salts, and all say the same. So they are parts of one code
(`fountain`) and are read together: what one salt's Gaussians have lost, another's make up for. Salts that
were lost are told by *pilots*, a few bits of each part that are known.

Which Gaussians hold a part, the key says in numbers that are held against a public hash of each name: the
next one above counts (consistent hashing, Karger et al. 1997). Where a Gaussian was lost, its own place is
lost and no other; a place is found in a sorted list, so that a wrong key costs next to nothing.
"""

from __future__ import annotations

import hashlib
import hmac
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt

from keyss.channels.colours.carriers import Carriers, Doubles, Names
from keyss.channels.colours.fountain import NOISY, Bits, Fountain
from keyss.channels.colours.lattice import COLUMNS, LEVELS, Lattice, dithers, rank
from keyss.channels.colours.salts import SALTS, Salts
from keyss.channels.mixing import Words, mixed
from keyss.keys.derivation import SALT_BYTES, DerivedKey, KeyDerivation, expand, stream

FILE_KEY_BYTES = 5
_PILOTS = 16  # numbers of these that are known beforehand
UNNOTICED = 2  # secrets whose headers are always there, if only as noise, unless one gets all carriers
SHARES = 256  # parts of the carriers; a payload has some of them
IDLE = 1 / 32  # unit of the share of carriers that were left alone
_CHECK_BYTES = 2
_FIELDS = (("level", 6), ("reserved", 2), ("depth", 3), ("first", 8), ("last", 8), ("bucket", 8), ("idle", 5))
_FIELD_BYTES = 5
_PARTITION_BYTES = 2
_BYTES = FILE_KEY_BYTES + _PARTITION_BYTES + _FIELD_BYTES + _CHECK_BYTES
_ROUNDS = 20
_TRIES = 3  # to tell salts that were lost
_PRIOR = 0.4  # logarithm of the odds that a salt is one, before anything else is known
_MIN_TRUST, _MAX_TRUST = 0.02, 0.95
_DECODED = 0.3  # weight of a bit that was decoded beside one that was known
_PUBLIC = hashlib.sha256(b"keyss/v1/robust-places").digest()
_STATIC_SALT = hashlib.sha256(b"keyss/v1/robust-static").digest()[:SALT_BYTES]
_PAD = np.uint64(0x9FB21C651E98DF25)


@dataclass(frozen=True)
class Kind:
    """How headers are written."""

    places: int  # Gaussians for each salt
    lattice: Lattice  # that gives as many bits to all

    @staticmethod
    def of(depth: int) -> Kind:
        """Of a payload that hardly shows, or of one that shows anyway and may cost more."""
        return KINDS[min(len(KINDS), depth) - 1]

    @property
    def bits(self) -> int:
        """Of one Gaussian."""
        return COLUMNS * self.lattice.depth

    def seeds(self, secret: bytes, names: Names) -> Words:
        """[bits C] of the numbers of Gaussians with these names."""
        words = rank(secret, "header-seeds", names)
        order = np.arange(1, self.bits + 1, dtype=np.uint64)
        return mixed((words[:, None] ^ mixed(order)).ravel())

    def share(self, carriers: int) -> float:
        """Of so many carriers, those that the headers of one secret take."""
        return 1 - math.exp(-SALTS * self.places / max(1, carriers))


KINDS = tuple(Kind(places, Lattice(LEVELS - 1, depth)) for depth, places in enumerate((64, 96), start=1))
_USUAL, _MERGED = (0.65,), (0.4, 0.2)
# How a header is looked at: of which kind, and how likely its places, and the ones after them, hold what was
# written. Where two models were put together, half of the places are the other's.
VIEWS = ((KINDS[0], _USUAL), (KINDS[1], _USUAL), (KINDS[1], _MERGED))


@dataclass(frozen=True)
class Header:
    """How a payload is read."""

    file_key: bytes
    partition: bytes  # by which carriers are shared out; the same for all secrets of a file
    level: int  # of the lattice
    depth: int  # of the lattice
    first: int  # of SHARES that the payload has,
    last: int  # this one included
    bucket: int  # see `bucket_bytes`
    idle: int  # share of its carriers that hold nothing, in units of IDLE
    reserved = 0

    @property
    def lattice(self) -> Lattice:
        return Lattice(self.level, self.depth)

    @property
    def kind(self) -> Kind:
        return Kind.of(self.depth)

    def own(self, carriers: Carriers) -> npt.NDArray[np.bool_]:
        """[C] which carriers the payload has, by a hash of their names that holders of keys know."""
        part = rank(self.partition, "partition", carriers.names) % np.uint64(SHARES)
        found: npt.NDArray[np.bool_] = (part >= self.first) & (part <= self.last)
        return found

    def pack(self, check: bytes) -> Bits:
        """The bits of a header; `check`: a secret that recognises it."""
        packed = 0
        for name, bits in _FIELDS:
            packed = packed << bits | getattr(self, name)
        plain = self.file_key + self.partition + packed.to_bytes(_FIELD_BYTES, "big")
        return np.unpackbits(np.frombuffer(plain + _check(check, plain), np.uint8))

    @staticmethod
    def unpack(bits: Bits, check: bytes) -> Header | None:
        """None where it is not one: by chance one of 2^16 is, and opens nothing."""
        data = np.packbits(bits).tobytes()
        plain, tag = data[:-_CHECK_BYTES], data[-_CHECK_BYTES:]
        if not hmac.compare_digest(tag, _check(check, plain)):
            return None
        packed, found = int.from_bytes(plain[-_FIELD_BYTES:], "big"), {}
        for name, size in reversed(_FIELDS):
            found[name], packed = packed & ((1 << size) - 1), packed >> size
        if found.pop("reserved") or found["depth"] == 0 or found["last"] < found["first"]:
            return None
        return Header(plain[:FILE_KEY_BYTES], plain[FILE_KEY_BYTES:-_FIELD_BYTES], **found)


class Index:
    """C carriers by the public hash of their names: in which order places are looked for."""

    def __init__(self, carriers: Carriers) -> None:
        fine = KINDS[-1].lattice.bits(carriers) == KINDS[-1].lattice.depth  # all but impossible sizes
        self._original, carriers = np.flatnonzero(fine), carriers[fine]
        hashes = rank(_PUBLIC, "places", carriers.names)
        order = np.argsort(hashes)
        hashes = hashes[order]
        first = np.flatnonzero(np.concatenate([[True], hashes[1:] != hashes[:-1]])) if len(order) else order
        self._carriers, self._rows, self._hashes = carriers, order[first], hashes[first]
        self._namesakes = np.diff(np.append(first, len(order)))

    def __len__(self) -> int:
        """How many names there are."""
        return len(self._rows)

    def places(self, secret: bytes, count: int, behind: int = 0) -> npt.NDArray[np.int64]:
        """[count] names that this secret's header is in, or those so many behind."""
        points = np.frombuffer(stream(secret, "robust/places", 8 * count), "<u8")
        found: npt.NDArray[np.int64] = (np.searchsorted(self._hashes, points) + behind) % len(self)
        return found

    def rows(self, places: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """[...] a carrier with each name."""
        found: npt.NDArray[np.int64] = self._original[self._rows[places]]
        return found

    def parts(self, secrets: Sequence[bytes], kind: Kind, view: Sequence[float], most: int) -> Parts:
        """What the first `most` Gaussians of each salt hold, if it is one."""
        seeds, hints = [], []
        for behind, sure in enumerate(view):
            places = np.stack([self.places(secret, most, behind) for secret in secrets])
            own = self._carriers[self._rows[places.ravel()]]
            names = own.names.reshape(*places.shape, -1)
            dither = np.concatenate([dithers(*each) for each in zip(secrets, names, strict=True)])
            words = np.stack([kind.seeds(*each) for each in zip(secrets, names, strict=True)])
            read = kind.lattice.read_dithered(dither, own, np.zeros(len(own))).reshape(words.shape)
            certain = sure * (1 - own.doubt) / self._namesakes[places.ravel()]
            hint = np.tanh(read / 2) * np.repeat(certain, kind.bits).reshape(words.shape)
            seeds.append(words)
            hints.append(hint * (1 - 2.0 * _pads(words)))
        words, every = np.stack(seeds), np.stack(hints)
        return Parts(words[:, :, _PILOTS:], every[:, :, _PILOTS:], every[:, :, :_PILOTS])

    def promise(self, secrets: Sequence[bytes]) -> float:
        """How much likelier what is known beforehand is with a header than without: a logarithm."""
        if not len(self) or not secrets:
            return -math.inf
        odds = [self.parts(secrets, kind, _USUAL, _PILOTS // kind.bits).odds for kind in KINDS]
        return max(float(np.logaddexp(0, each.clip(-50, 50)).sum()) for each in odds)


@dataclass(frozen=True)
class Parts:
    """Code bits of a header under S salts, as V Gaussians of each place say; hints are P(0) - P(1)."""

    seeds: Words  # [V, S, B]
    hints: Doubles  # [V, S, B] if it is a salt
    pilots: Doubles  # [V, S, ...] the same of bits that are 0

    @property
    def odds(self) -> Doubles:
        """[S] logarithms of the odds that each is a salt."""
        found: Doubles = _PRIOR + np.log1p(self.pilots.clip(-0.99)).sum(axis=(0, 2))
        return found


def written_header(
    header: Header, check: bytes, secret: bytes, index: Index, carriers: Carriers, free: npt.NDArray[np.bool_]
) -> tuple[npt.NDArray[np.int64], Doubles]:
    """[P] the carriers of those that are free [C] which hold a header, and [P, 2] their new values."""
    kind = header.kind
    own = index.rows(index.places(secret, kind.places))
    words = kind.seeds(secret, carriers.names[own])
    bits = _fountain().encode(header.pack(check), words)
    bits[:_PILOTS] = 0
    values = kind.lattice.write(secret, carriers[own], bits ^ _pads(words))
    rows, first = np.unique(own, return_index=True)
    fine = free[rows]
    return rows[fine], values[first[fine]]


def read_header(
    secrets: Sequence[bytes], check: bytes, index: Index, kind: Kind, view: Sequence[float]
) -> Header | None:
    """The header of this kind whose parts lie under these secrets, if there is one."""
    if not len(index) or not secrets:
        return None
    parts, fountain = index.parts(secrets, kind, view, kind.places), _fountain()
    seeds, odds = parts.seeds.ravel(), parts.odds
    trusts = _trusts(odds)
    for _ in range(_TRIES):
        sure = (parts.hints * trusts[:, None]).clip(-0.9999, 0.9999)
        ratios = (2 * np.arctanh(sure)).astype(np.float32).ravel()
        every, _ = fountain.likeliest(seeds, ratios, _ROUNDS)
        header = Header.unpack(every[: fountain.size], check)
        if header is not None:
            return header
        agree = parts.hints * (1 - 2.0 * fountain.sums(every, seeds).reshape(parts.hints.shape))
        trusts = _trusts(odds + _DECODED * np.log1p(agree.clip(-0.99)).sum(axis=(0, 2)))
    return None


def header_agreement(header: Header, check: bytes, secrets: Sequence[bytes], index: Index) -> float:
    """How far what lies under these secrets agrees with the header: 0 by chance."""
    if not len(index) or not secrets:
        return 0.0
    parts = index.parts(secrets, header.kind, _USUAL, header.kind.places)
    bits = _fountain().encode(header.pack(check), parts.seeds.ravel()).reshape(parts.seeds.shape)
    return float((parts.hints * (1 - 2.0 * bits)).sum() + parts.pilots.sum())


def _trusts(odds: Doubles) -> Doubles:
    trusts: Doubles = (1 / (1 + np.exp(-odds.clip(-50, 50)))).clip(_MIN_TRUST, _MAX_TRUST)
    return trusts


def bucket_bytes(bucket: int) -> int:
    """The size that a number of one byte stands for: 32 to 2 million bytes in steps of 3 to 6 %."""
    return (16 + bucket % 16) << (bucket // 16 + 1)


def _check(secret: bytes, plain: bytes) -> bytes:
    return hmac.digest(secret, plain, "sha256")[:_CHECK_BYTES]


def derived(key: str, salts: Salts) -> tuple[bytes, tuple[bytes, ...]]:
    """What a key becomes without a salt of the file, and with each; takes about 0.1 s for each.

    The salts make every guess cost Argon2id anew for each file. The other secret makes up for the few bytes
    of a header: whoever does not know the key has to guess both.
    """
    secrets = [_derived(key, salt).expand("robust/header", 32) for salt in salts.salts]
    return _derived(key, _STATIC_SALT).expand("robust/static", 32), tuple(secrets)


def data_key(static: bytes, header: Header) -> bytes:
    """The key that encrypts a payload, different in every file."""
    return expand(static + header.file_key, "robust/data-key", 32)


def check_secret(static: bytes) -> bytes:
    """What recognises headers, of what the key is without a salt."""
    return expand(static, "robust/check", 32)


def _derived(key: str, salt: bytes) -> DerivedKey:
    return DerivedKey(key, KeyDerivation(salt=salt))


def _pads(seeds: Words) -> Bits:
    """[B] bits by which the code is encrypted."""
    return (mixed(seeds ^ _PAD) >> np.uint64(63)).astype(np.uint8)


@cache
def _fountain() -> Fountain:
    return Fountain.of(8 * _BYTES, NOISY)
