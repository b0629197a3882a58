"""The header, on which a key is tried first: how to read the rest, in a few Gaussians that the key chooses.

There is a *header* under each of a few salts, and all are equal. So they are parts of one code (`fountain`)
and are read together: one salt's Gaussians replace the lost ones of another. *Pilots*, a few known bits of
each part, tell which salts were lost.

The key chooses the Gaussians of a part by random numbers: each stands for the name with the next larger
public hash (consistent hashing, Karger et al. 1997). A lost Gaussian costs its own place and no other, and
places are found in a sorted list, so that a wrong key costs next to nothing.
"""

from __future__ import annotations

import hashlib
import hmac
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from keyss.channels.colours.carriers import SALTS, Carriers, Names, rank
from keyss.channels.colours.fountain import NOISY, Fountain
from keyss.channels.colours.lattice import COLUMNS, MAX_BITS, bit_counts, dithers, read, seeds, write
from keyss.channels.mixing import mixed
from keyss.core.arrays import Bits, Doubles, Flags, Integers, Words
from keyss.keys.derivation import SALT_BYTES, DerivedKey, expand, stream

FILE_KEY_BYTES = 5
_PILOTS = 16  # bits of a header under each salt that are known beforehand
UNNOTICED = 2  # secrets whose headers are always there, if only as noise, unless one gets all carriers
SHARES = 256  # parts of the carriers; a payload has some of them
IDLE = 1 / 32  # unit of the share of carriers that were left alone
_CHECK_BYTES = 2
_FIELDS = (("level", 8), ("depth", 3), ("first", 8), ("last", 8), ("bucket", 8), ("idle", 5))
_FIELD_BYTES = 5
_PARTITION_BYTES = 2
_BYTES = FILE_KEY_BYTES + _PARTITION_BYTES + _FIELD_BYTES + _CHECK_BYTES
_ROUNDS = 20
_TRIES = 3  # to tell salts that were lost
_PRIOR = 0.4  # logarithm of the odds that a salt is one, before anything else is known
_MIN_TRUST, _MAX_TRUST = 0.02, 0.95
_DECODED = 0.3  # weight of a bit that was decoded beside one that was known
_PUBLIC = hashlib.sha256(b"keyss/v1/colours-places").digest()
_STATIC_SALT = hashlib.sha256(b"keyss/v1/colours-static").digest()[:SALT_BYTES]
_PAD = np.uint64(0x9FB21C651E98DF25)


@dataclass(frozen=True)
class Kind:
    """How headers are written."""

    places: int  # Gaussians for each salt
    depth: int  # bits of each of their numbers

    @staticmethod
    def of(depth: int) -> Kind:
        """The kind for a payload of this depth: one that hardly shows, or one that shows anyway."""
        return KINDS[min(len(KINDS), depth) - 1]

    def share(self, carriers: int) -> float:
        """Share of so many carriers that the headers of one secret take."""
        return 1 - math.exp(-SALTS * self.places / max(1, carriers))

    def bits(self, carriers: int) -> Integers:
        """[C] bits of each of their numbers."""
        return np.full(carriers, self.depth)


KINDS = (Kind(64, 1), Kind(96, 2))
# How likely a place, and the ones after it, hold what was written: in an ordinary model, and in two merged
# ones, where half of the places are the other's.
_USUAL, _MERGED = (0.65,), (0.4, 0.2)
VIEWS = ((KINDS[0], _USUAL), (KINDS[1], _USUAL), (KINDS[1], _MERGED))


@dataclass(frozen=True)
class Header:
    """How a payload is read."""

    file_key: bytes
    partition: bytes  # by which carriers are shared out; the same for all secrets of a file
    level: int  # see `bit_counts`
    depth: int
    first: int  # of SHARES that the payload has,
    last: int  # this one included
    bucket: int  # see `bucket_bytes`
    idle: int  # share of its carriers that hold nothing, in units of IDLE

    @property
    def kind(self) -> Kind:
        return Kind.of(self.depth)

    def bits(self, carriers: Carriers) -> Integers:
        """[C] bits of the payload in each number."""
        return bit_counts(carriers, self.level, self.depth)

    def own(self, carriers: Carriers) -> Flags:
        """[C] which carriers the payload has, by a hash of their names that holders of keys know."""
        part = rank(self.partition, "partition", carriers.names) % np.uint64(SHARES)
        return (part >= self.first) & (part <= self.last)

    def pack(self, check: bytes) -> Bits:
        """The bits of a header; `check`: a secret that recognises it."""
        packed = 0
        for name, bits in _FIELDS:
            packed = packed << bits | getattr(self, name)
        plain = self.file_key + self.partition + packed.to_bytes(_FIELD_BYTES, "big")
        return np.unpackbits(np.frombuffer(plain + _check(check, plain), np.uint8))

    @staticmethod
    def unpack(bits: Bits, check: bytes) -> Header | None:
        """None for other bits; one in 2^16 of them is taken for a header by chance, and opens nothing."""
        data = np.packbits(bits).tobytes()
        plain, tag = data[:-_CHECK_BYTES], data[-_CHECK_BYTES:]
        if not hmac.compare_digest(tag, _check(check, plain)):
            return None
        packed, numbers = int.from_bytes(plain[-_FIELD_BYTES:], "big"), {}
        for name, size in reversed(_FIELDS):
            numbers[name], packed = packed & ((1 << size) - 1), packed >> size
        if not 1 <= numbers["depth"] <= MAX_BITS or numbers["last"] < numbers["first"]:
            return None
        return Header(plain[:FILE_KEY_BYTES], plain[FILE_KEY_BYTES:-_FIELD_BYTES], **numbers)


class Index:
    """C carriers by the public hash of their names: the order in which places are looked for."""

    def __init__(self, carriers: Carriers) -> None:
        hashes = rank(_PUBLIC, "places", carriers.names)
        order = np.argsort(hashes)
        hashes = hashes[order]
        first = np.flatnonzero(np.concatenate([[True], hashes[1:] != hashes[:-1]])) if len(order) else order
        self._carriers, self._rows, self._hashes = carriers, order[first], hashes[first]
        self._namesakes = np.diff(np.append(first, len(order)))

    def __len__(self) -> int:
        """How many names there are."""
        return len(self._rows)

    def rows(self, secret: bytes, kind: Kind) -> Integers:
        """[places] a carrier with each name that this secret's header is in."""
        return self._rows[self._places(secret, kind.places, 0)]

    def _places(self, secret: bytes, count: int, behind: int) -> Integers:
        points = np.frombuffer(stream(secret, "colours/places", 8 * count), "<u8")
        return (np.searchsorted(self._hashes, points) + behind) % len(self)

    def parts(
        self, secrets: Sequence[bytes], kind: Kind, view: Sequence[float], count: int | None = None
    ) -> Parts:
        """The bits in the first `count` Gaussians of each salt, by default in all of them."""
        count = kind.places if count is None else count
        every, hints = [], []
        for behind, sure in enumerate(view):
            places = np.stack([self._places(secret, count, behind) for secret in secrets])
            own = self._carriers[self._rows[places.ravel()]]
            names = own.names.reshape(*places.shape, -1)
            dither = np.concatenate([dithers(*each) for each in zip(secrets, names, strict=True)])
            words = np.stack([_seeds(kind, *each) for each in zip(secrets, names, strict=True)])
            ratios = read(dither, own, kind.bits(len(own)), np.zeros(len(own))).reshape(words.shape)
            certain = sure * (1 - own.doubt) / self._namesakes[places.ravel()]
            hint = np.tanh(ratios / 2) * np.repeat(certain, COLUMNS * kind.depth).reshape(words.shape)
            every.append(words)
            hints.append(hint * (1 - 2.0 * _pads(words)))
        both = np.stack(hints)
        return Parts(np.stack(every)[:, :, _PILOTS:], both[:, :, _PILOTS:], both[:, :, :_PILOTS])

    def promise(self, secrets: Sequence[bytes]) -> float:
        """Logarithm of how much likelier the pilots are with a header than without."""
        if not len(self) or not secrets:
            return -math.inf
        odds = [self.parts(secrets, kind, _USUAL, _PILOTS // (COLUMNS * kind.depth)).odds for kind in KINDS]
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
        odds: Doubles = _PRIOR + np.log1p(self.pilots.clip(-0.99)).sum(axis=(0, 2))
        return odds


def written_header(
    header: Header, check: bytes, secret: bytes, index: Index, carriers: Carriers, free: Flags
) -> tuple[Integers, Doubles]:
    """[P] those of the carriers that are `free` [C] which hold a header, and [P, 2] their new values."""
    kind = header.kind
    own = index.rows(secret, kind)
    words = _seeds(kind, secret, carriers.names[own])
    bits = _fountain().encode(header.pack(check), words)
    bits[:_PILOTS] = 0
    values = write(secret, carriers[own], kind.bits(len(own)), bits ^ _pads(words))
    rows, first = np.unique(own, return_index=True)
    fine = free[rows]
    return rows[fine], values[first[fine]]


def read_header(
    secrets: Sequence[bytes], check: bytes, index: Index, kind: Kind, view: Sequence[float]
) -> Header | None:
    """The header of this kind whose parts lie under these secrets, if there is one."""
    if not len(index) or not secrets:
        return None
    parts, fountain = index.parts(secrets, kind, view), _fountain()
    words, odds = parts.seeds.ravel(), parts.odds
    trusts = _trusts(odds)
    for _ in range(_TRIES):
        sure = (parts.hints * trusts[:, None]).clip(-0.9999, 0.9999)
        ratios = (2 * np.arctanh(sure)).astype(np.float32).ravel()
        every, _ = fountain.likeliest(words, ratios, _ROUNDS)
        header = Header.unpack(every[: fountain.size], check)
        if header is not None:
            return header
        agree = parts.hints * (1 - 2.0 * fountain.sums(every, words).reshape(parts.hints.shape))
        trusts = _trusts(odds + _DECODED * np.log1p(agree.clip(-0.99)).sum(axis=(0, 2)))
    return None


def header_agreement(header: Header, check: bytes, secrets: Sequence[bytes], index: Index) -> float:
    """How well the parts under these secrets agree with the header: 0 by chance."""
    if not len(index) or not secrets:
        return 0.0
    parts = index.parts(secrets, header.kind, _USUAL)
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


def derived(key: str, salts: Sequence[bytes]) -> tuple[bytes, tuple[bytes, ...]]:
    """`key` without a salt of the file, and under each; takes about 0.1 s for each.

    The salts make every guess cost Argon2id anew for each file. The other secret makes up for the few bytes
    of a header: an attacker has to guess both.
    """
    secrets = [DerivedKey.of(key, salt).expand("colours/header", 32) for salt in salts]
    return DerivedKey.of(key, _STATIC_SALT).expand("colours/static", 32), tuple(secrets)


def data_key(static: bytes, header: Header) -> bytes:
    """The key that encrypts a payload, different in every file."""
    return expand(static + header.file_key, "colours/data-key", 32)


def check_secret(static: bytes) -> bytes:
    """The secret that recognises headers, from the key without a salt."""
    return expand(static, "colours/check", 32)


def _seeds(kind: Kind, secret: bytes, names: Names) -> Words:
    return seeds(secret, "header-seeds", names, kind.bits(len(names)))


def _pads(words: Words) -> Bits:
    """[B] bits that encrypt the code."""
    return (mixed(words ^ _PAD) >> np.uint64(63)).astype(np.uint8)


@cache
def _fountain() -> Fountain:
    return Fountain(8 * _BYTES, NOISY)
