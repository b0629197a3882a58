"""The header, on which a key is tried first: how to read the rest, in a few Gaussians that the key chooses.

There is a *header* under each of a few salts, and all are equal. So they are parts of one code (`fountain`)
and are read together: one salt's Gaussians replace the lost ones of another. *Pilots*, a few known bits of
each part, tell which salts were lost, and then what was decoded does.

The key chooses the Gaussians whose names it gives the least random numbers: a lost one costs its own place
and no other.
"""

from __future__ import annotations

import hashlib
import hmac
import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from keyss.channels.colours.carriers import Carriers, fractions
from keyss.channels.colours.fountain import NOISY, Fountain
from keyss.channels.colours.qim import COLUMNS, ONE, read, seeds, write
from keyss.core.arrays import Bits, Doubles, Flags, Integers
from keyss.keys.derivation import SALT_BYTES, DerivedKey, expand

PLACES = 80  # Gaussians of a header under each salt
DEPTHS = (1, 2)  # bits of each of their numbers beside a payload at level ONE, and beside one at any other
SHARES = 256  # parts of the carriers; a payload has some of them
IDLE = 1 / 255  # unit of the share of carriers that were left alone
FILE_KEY_BYTES = 5
_PILOTS = 10  # of the places
_FORMAT = f"{FILE_KEY_BYTES}s6B"
_CHECK_BYTES = 2
_PRIOR = 0.4  # logarithm of the odds that a salt is one, before anything else is known
_TRIES = 3  # to tell salts that were lost
_DECODED = 0.3  # weight of a bit that was decoded beside one that was known
_HELD = 0.5  # chance that a place under a salt holds what was written
_STATIC_SALT = hashlib.sha256(b"keyss/v1/colours-static").digest()[:SALT_BYTES]
_CODE = Fountain(8 * (struct.calcsize(_FORMAT) + _CHECK_BYTES), NOISY)
_MEDIAN_STEPS = 8  # of impact, in one


@dataclass(frozen=True)
class Secrets:
    """The secrets of one key in one file."""

    static: bytes  # the same in every file
    salted: tuple[bytes, ...]  # under each salt

    @staticmethod
    def of(key: str, salts: Sequence[bytes]) -> Secrets:
        """Takes about 0.1 s for each salt and one more.

        The salts make every guess cost Argon2id anew for each file. The static secret makes up for the few
        bytes of a header: an attacker has to guess both.
        """
        salted = tuple(DerivedKey.of(key, salt).expand("colours/header", 32) for salt in salts)
        return Secrets(DerivedKey.of(key, _STATIC_SALT).expand("colours/static", 32), salted)

    def data_key(self, header: Header) -> bytes:
        """The key that encrypts a payload, different in every file."""
        return expand(self.static + header.file_key, "colours/data-key", 32)

    def check(self, plain: bytes) -> bytes:
        """_CHECK_BYTES that recognise a header."""
        return hmac.digest(expand(self.static, "colours/check", 32), plain, "sha256")[:_CHECK_BYTES]


@dataclass(frozen=True)
class Header:
    """How a payload is read; numbers are below 256."""

    file_key: bytes  # the same for all secrets of a file
    level: int  # see `bit_counts`
    first: int  # of SHARES that the payload has,
    last: int  # this one included
    bucket: int  # see `bucket_bytes`
    idle: int  # share of its carriers that hold nothing, in units of IDLE
    median: int  # see `median`

    def carrier_mask(self, carriers: Carriers) -> Flags:
        """[C] which carriers the payload has, by a hash of their names that holders of keys know."""
        part = np.floor(SHARES * fractions(self.file_key, "partition", carriers.names)[:, 0])
        return (part >= self.first) & (part <= self.last)

    def shift(self, carriers: Carriers) -> float:
        """How much larger impacts are than when the header was written, from their median."""
        off = (median(carriers) - self.median + 128) % 256 - 128
        return off / _MEDIAN_STEPS

    def bits(self, secrets: Secrets) -> Bits:
        """The header and what recognises it, as zeros and ones."""
        numbers = (self.level, self.first, self.last, self.bucket, self.idle, self.median)
        plain = struct.pack(_FORMAT, self.file_key, *numbers)
        return np.unpackbits(np.frombuffer(plain + secrets.check(plain), np.uint8))

    def write(self, secrets: Secrets, salt: int, carriers: Carriers) -> tuple[Integers, Doubles]:
        """[P] the carriers that hold the header under one salt, and [P, 2] their new values."""
        secret, depth = secrets.salted[salt], DEPTHS[self.level != ONE]
        rows, pilots = places(secret, carriers)
        names, counts = carriers.names[rows], np.full(len(rows), depth)
        code = _CODE.encode(self.bits(secrets), seeds(secret, "header-seeds", names, counts))
        code[np.repeat(pilots, COLUMNS * depth)] = 0
        return rows, write(secret, names, carriers.colours[rows, 1:], counts, code)

    @staticmethod
    def read(secrets: Secrets, carriers: Carriers) -> Header | None:
        """None where there is none; one attempt in 2^16 finds one by chance, which opens nothing."""
        found = [places(secret, carriers) for secret in secrets.salted]
        headers = [_read(secrets, carriers, found, depth) for depth in DEPTHS]
        return headers[0] or headers[1]


def _read(
    secrets: Secrets, carriers: Carriers, found: Sequence[tuple[Integers, Flags]], depth: int
) -> Header | None:
    """The header with `depth` bits in each number of the places `found`."""
    words, hints, owners, odds = [np.zeros(0, np.uint64)], [np.zeros(0)], [np.zeros(0, np.int64)], []
    for salt, (secret, (rows, pilots)) in enumerate(zip(secrets.salted, found, strict=True)):
        names, counts = carriers.names[rows], np.full(len(rows), depth)
        known = np.repeat(pilots, COLUMNS * depth)
        sure = np.repeat(_HELD * (1 - carriers.error_probability[rows]) / carriers.name_counts[rows], COLUMNS * depth)
        every = sure * read(secret, names, carriers.colours[rows, 1:], counts)
        odds.append(_PRIOR + np.log1p(every[known]).sum())
        hints.append(every[~known])
        words.append(seeds(secret, "header-seeds", names, counts)[~known])
        owners.append(np.full(len(hints[-1]), salt))
    word, hint, owner = np.concatenate(words), np.concatenate(hints), np.concatenate(owners)
    header, agreement = None, np.zeros(len(odds))
    for _ in range(_TRIES):  # all of them, so that a right key takes as long as a wrong one
        trust = 1 / (1 + np.exp(-np.array(odds) - _DECODED * agreement))
        data = _CODE.decode(word, hint * trust[owner])
        packed = np.packbits(data).tobytes()
        plain, check = packed[:-_CHECK_BYTES], packed[-_CHECK_BYTES:]
        if header is None and hmac.compare_digest(check, secrets.check(plain)):
            header = Header(*struct.unpack(_FORMAT, plain))
        logs = np.log1p(hint * (1 - 2.0 * _CODE.encode(data, word)))
        agreement = np.bincount(owner, logs, len(odds)).astype(np.float64)
    return header


def places(secret: bytes, carriers: Carriers) -> tuple[Integers, Flags]:
    """[P] the carriers with the PLACES names that a secret chooses, and which of them are pilots."""
    numbers = fractions(secret, "places", carriers.names)[:, 0]
    least = np.append(np.unique(numbers), 1.0)
    rows = np.flatnonzero(numbers < least[: PLACES + 1][-1])
    return rows, numbers[rows] < least[: _PILOTS + 1][-1]


def median(carriers: Carriers) -> float:
    """The median impact, in steps; headers state its remainder by 256."""
    return _MEDIAN_STEPS * float(np.median(carriers.impact)) if len(carriers) else 0.0


def bucket_bytes(bucket: int) -> int:
    """The size that a number of one byte stands for: 32 to 2 million bytes in steps of 3 to 6 %."""
    return (16 + bucket % 16) << (bucket // 16 + 1)
