"""The header, which tells how to read a payload: in a few Gaussians that the key chooses.

A key is first tried on the header. A fountain code encodes the header; each of a few salts has a part of the
code. Decoding all parts together compensates for lost salts. *Pilots*, a few known bits of each part, show
which salts are lost; agreement with the decoded bits refines that.

A key assigns pseudo-random numbers to IDs and chooses the Gaussians with the smallest: a lost Gaussian
displaces no other.
"""

from __future__ import annotations

import hashlib
import hmac
import struct
from collections.abc import Sequence
from dataclasses import astuple, dataclass

import numpy as np

from keyss.channels.colours.carriers import Carriers, fractions
from keyss.channels.colours.fountain import NOISY, Fountain
from keyss.channels.colours.qim import COLUMNS, ONE, read, seeds, write
from keyss.channels.container import key_secret
from keyss.core.arrays import Doubles, Flags, Integers
from keyss.keys.derivation import SALT_BYTES, DerivedKey, expand

PLACES = 80  # Gaussians of a header under each salt
_DEPTHS = (1, 2)  # bits per value of a header, for payloads at level ONE and at other levels
SHARES = 256  # parts of the carriers, divided among payloads
IDLE = 1 / 255  # unit of the share of unchanged carriers
FILE_KEY_BYTES = 5
_PILOTS = 10  # places whose bits are known
_FORMAT = f"{FILE_KEY_BYTES}s6B"
_CHECK_BYTES = 2
_PRIOR = 0.4  # prior log odds that a salt is genuine
_TRIES = 3  # rounds of reweighting salts
_DECODED = 0.3  # weight of decoded bits relative to known ones
_HELD = 0.5  # probability that a place is intact
_STATIC_SALT = hashlib.sha256(b"keyss/v1/colours-static").digest()[:SALT_BYTES]
_CODE = Fountain(8 * (struct.calcsize(_FORMAT) + _CHECK_BYTES), NOISY)
_MEDIAN_STEPS = 8  # per unit of impact


@dataclass(frozen=True)
class Secrets:
    """The secrets of one key in one file."""

    static: bytes  # the same in every file
    salted: tuple[bytes, ...]  # one per salt

    @staticmethod
    def of(key: str, salts: Sequence[bytes]) -> Secrets:
        """Derive the secrets, which takes about 0.1 s per salt and 0.1 s more.

        Because of the salts, an attacker pays for Argon2id again in every file. The static secret compensates
        for the small redundancy of a header: an attacker must guess both.
        """
        salted = tuple(key_secret(DerivedKey.of(key, salt)) for salt in salts)
        return Secrets(key_secret(DerivedKey.of(key, _STATIC_SALT)), salted)

    def data_key(self, header: Header) -> bytes:
        """The key that encrypts the payload in this file."""
        return expand(self.static + header.file_key, "colours/data-key", 32)

    def check(self, plain: bytes) -> bytes:
        """A MAC of _CHECK_BYTES, which recognises a header."""
        return hmac.digest(expand(self.static, "colours/check", 32), plain, "sha256")[:_CHECK_BYTES]


@dataclass(frozen=True)
class Header:
    """Parameters for reading a payload; numbers are below 256."""

    file_key: bytes  # the same for all secrets of a file
    level: int  # see `bit_counts`
    first: int  # first of the payload's parts of the carriers
    last: int  # last one, inclusive
    bucket: int  # see `bucket_bytes`
    idle: int  # share of the payload's carriers that hold nothing, in units of IDLE
    median: int  # see `median`

    def carrier_mask(self, carriers: Carriers) -> Flags:
        """Mask [C] of the payload's carriers, from a keyed hash of their IDs."""
        part = np.floor(SHARES * fractions(self.file_key, "partition", carriers.ids)[:, 0])
        return (part >= self.first) & (part <= self.last)

    def shift(self, carriers: Carriers) -> float:
        """The change of the median impact since the header was written."""
        off = (median(carriers) - self.median + 128) % 256 - 128
        return off / _MEDIAN_STEPS

    def write(self, secrets: Secrets, salt: int, carriers: Carriers) -> tuple[Integers, Doubles]:
        """The carriers [P] of the header under one salt, and their new values [P, 2]."""
        secret, depth = secrets.salted[salt], _DEPTHS[self.level != ONE]
        rows, pilots = places(secret, carriers)
        ids, counts = carriers.ids[rows], np.full(len(rows), depth)
        plain = struct.pack(_FORMAT, *astuple(self))
        data = np.unpackbits(np.frombuffer(plain + secrets.check(plain), np.uint8))
        code = _CODE.encode(data, seeds(secret, "header-seeds", ids, counts))
        code[np.repeat(pilots, COLUMNS * depth)] = 0
        return rows, write(secret, ids, carriers.colours[rows, 1:], counts, code)

    @staticmethod
    def read(secrets: Secrets, carriers: Carriers) -> Header | None:
        """None if there is none. One attempt in 2^16 finds a false header, which opens nothing."""
        found_places = [places(secret, carriers) for secret in secrets.salted]
        headers = [_read(secrets, carriers, found_places, depth) for depth in _DEPTHS]
        return headers[0] or headers[1]


def _read(
    secrets: Secrets, carriers: Carriers, chosen: Sequence[tuple[Integers, Flags]], depth: int
) -> Header | None:
    """The header with `depth` bits per value; `chosen`: see `places`, for each salt."""
    words, hints, owners, odds = [np.zeros(0, np.uint64)], [np.zeros(0)], [np.zeros(0, np.int64)], []
    for salt, (secret, (rows, pilots)) in enumerate(zip(secrets.salted, chosen, strict=True)):
        ids, counts = carriers.ids[rows], np.full(len(rows), depth)
        known = np.repeat(pilots, COLUMNS * depth)
        every = np.repeat(_HELD * carriers.certainty[rows], COLUMNS * depth) * read(
            secret, ids, carriers.colours[rows, 1:], counts
        )
        odds.append(_PRIOR + np.log1p(every[known]).sum())
        hints.append(every[~known])
        words.append(seeds(secret, "header-seeds", ids, counts)[~known])
        owners.append(np.full(len(hints[-1]), salt))
    word, hint, owner = np.concatenate(words), np.concatenate(hints), np.concatenate(owners)
    header, agreement = None, np.zeros(len(odds))
    for _ in range(_TRIES):  # no early exit, so that right and wrong keys take equally long
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
    """The carriers [P] with the PLACES IDs that a secret chooses, and a mask [P] of pilots."""
    numbers = fractions(secret, "places", carriers.ids)[:, 0]
    least = np.append(np.unique(numbers), 1.0)
    rows = np.flatnonzero(numbers < least[: PLACES + 1][-1])
    return rows, numbers[rows] < least[: _PILOTS + 1][-1]


def median(carriers: Carriers) -> float:
    """The median impact, in steps; headers store it modulo 256."""
    return _MEDIAN_STEPS * float(np.median(carriers.impact)) if len(carriers) else 0.0


def bucket_bytes(bucket: int) -> int:
    """The size of a bucket, 0 to 255: 32 bytes to 2 million, in steps of 3 to 6 %."""
    return (16 + bucket % 16) << (bucket // 16 + 1)
