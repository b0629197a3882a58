"""Secrets in appended Gaussians.

A payload is encrypted as a whole (ChaCha20-Poly1305 under a key that Argon2id gives with the file's salt),
cut into packets, and given parity by Reed-Solomon, each block of at most 255 packets for itself: any 150 of
them give it back. Every packet is a Gaussian. A header tells how many blocks there are and how long they are.
"""

from __future__ import annotations

import hashlib
import math
import os
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import torch

from keyss.channels import reed_solomon
from keyss.channels.appended import packets, pilots
from keyss.channels.appended.lattice import (
    Bits,
    Cube,
    Doubles,
    Points,
    Words,
    all_shifts,
    colours_of,
    in_own_frame,
    invariants_of,
    is_candidate,
    joined,
    likely_shifts,
    scale_steps,
    scales_at,
    to_gaussians,
)
from keyss.channels.appended.packets import NUMBER_BITS, PACKET_BYTES, Bytes
from keyss.channels.base import METHOD_BYTES, Payload, pack_method, unpack_method
from keyss.core.errors import InputError, KeyssWarning, UsageError, WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.keys.derivation import SALT_BYTES, DerivedKey, KeyDerivation, expand, stream
from keyss.keys.encryption import OVERHEAD, compressed_size, decrypt, encrypt

_LENGTH_BITS = 8  # of the packets of a block that hold data
_MOST_DATA = 150  # packets of a block that hold data
_MOST_BLOCKS = min(1 << NUMBER_BITS - _LENGTH_BITS, (1 << NUMBER_BITS) // reed_solomon.MAX_CHUNKS) - 1
# A quarter of the packets may be lost, and of the others what formats garble, with so many deviations more.
_LEFT, _DEVIATIONS = 0.72, 4.5
MOST_BYTES = _MOST_BLOCKS * _MOST_DATA * PACKET_BYTES - OVERHEAD - METHOD_BYTES

# Gaussians in which pilots are counted; places of the lattice that are tried then, with so many deviations
# more of them than by chance.
_SAMPLE, _TRIED, _NOT_BY_CHANCE = 8000, 8, 3.0
_ASSOCIATED = b"keyss/v1/appended/data"
_OPENS_NOTHING = "this key opens nothing here"
_NOTICED = (
    "the number of appended Gaussians tells how much is hidden in all: who holds one of the keys sees that "
    "there are other secrets"
)


def appended_for(size: int) -> int:
    """Gaussians that a payload of `size` compressed bytes takes, alone in a model."""
    own = packets.HEADERS + _Blocks.of(size).packets
    return own + pilots.count_for(own)


def embed(
    model: Gaussians, secrets: Sequence[tuple[str, Payload]], *, entropy: bytes | None = None
) -> Gaussians:
    """The model with one (key, payload) for each secret in Gaussians after its own.

    `entropy`: at least 32 bytes that nobody else can know, by default the system's. Raises UsageError for
    equal keys, for none, and for more than fits. Warns (KeyssWarning) where there is more than one secret.
    """
    mixed = hashlib.sha256(os.urandom(32) if entropy is None else entropy)
    for _, payload in secrets:
        mixed.update(hashlib.sha256(_packed(payload)).digest())
    secret = mixed.digest()
    salt = expand(secret, "appended/salt", SALT_BYTES)
    random = np.random.default_rng(np.frombuffer(stream(secret, "appended/random", 32), np.uint32))
    derivation = KeyDerivation(salt=salt)
    keys = [DerivedKey(key, derivation) for key, _ in secrets]
    if not keys or any(a.equals(b) for a, b in combinations(keys, 2)):
        raise UsageError("two secrets have the same key: expected at least one secret, each with its own")
    if len(keys) > 1:
        warnings.warn(_NOTICED, KeyssWarning, stacklevel=2)
    words = [_words(key, payload, random) for key, (_, payload) in zip(keys, secrets, strict=True)]
    words.append(pilots.write(salt, pilots.count_for(sum(map(len, words))), random))
    every = np.concatenate(words)[random.permutation(sum(map(len, words)))]
    model = model.detach().to("cpu")
    return Gaussians.cat([model, to_gaussians(every, Cube.around(model), model.sh_degree)])


@dataclass(frozen=True)
class AppendedReader:
    """A model's appended Gaussians as a reader sees them."""

    salt: bytes
    words: Bits

    @staticmethod
    def of(model: Gaussians) -> AppendedReader | None:
        """None where there are none, or where their frame cannot be found."""
        candidates = is_candidate(model)
        if candidates.sum() < pilots.LEAST // 4:
            return None
        faint = model.detach().to("cpu")[torch.from_numpy(candidates)]
        colours, steps = colours_of(faint), scale_steps(faint)
        few = np.random.default_rng(0).permutation(len(faint))[:_SAMPLE]
        for shifts in (likely_shifts(steps), _shifts_with_pilots(steps[few], colours[few])):
            best: tuple[pilots.Found, Points] | None = None
            for shift in shifts:
                scales = scales_at(steps, shift)
                found = pilots.read(invariants_of(colours, scales), faint.means.double().numpy())
                if found and (best is None or found.agreeing > best[0].agreeing):
                    best = found, scales
            if best is not None:
                found, scales = best
                return AppendedReader(found.salt, joined(colours, scales, in_own_frame(faint, found.to_own)))
        return None

    def open(self, key: str) -> Payload:
        """What `key` opens. Raises WrongKeyError, and InputError where too much was lost or changed."""
        return self.extract(DerivedKey(key, KeyDerivation(salt=self.salt)))

    def extract(self, derived: DerivedKey) -> Payload:
        """`open` after key derivation."""
        header = packets.read_header(derived.expand("appended/header", 32), self.words)
        blocks = header and _Blocks.of_header(header)
        if not blocks:
            raise WrongKeyError(_OPENS_NOTHING)
        numbers, data = packets.read(derived.expand("appended/packets", 32), self.words)
        try:
            plain = decrypt(derived.expand("appended/data", 32), blocks.decode(numbers, data), _ASSOCIATED)
            return Payload(unpack_method(plain), plain[METHOD_BYTES:])
        except ValueError as error:
            raise InputError(f"the hidden data are damaged: {error}") from error


@dataclass(frozen=True)
class _Blocks:
    """Packets of a payload in blocks of one size."""

    count: int
    data: int  # packets of one that hold data

    @staticmethod
    def of(size: int) -> _Blocks:
        """For `size` bytes of compressed payload; raises UsageError for more than fit."""
        needed = -(-(size + OVERHEAD) // PACKET_BYTES)
        count = -(-needed // _MOST_DATA)
        if count > _MOST_BLOCKS:
            raise UsageError(f"the secret takes {size:,} bytes, and {MOST_BYTES:,} can be appended")
        return _Blocks(count, -(-needed // count))

    @staticmethod
    def of_header(header: int) -> _Blocks | None:
        count, data = header >> _LENGTH_BITS, header & (1 << _LENGTH_BITS) - 1
        return _Blocks(count, data) if 0 < count <= _MOST_BLOCKS and 0 < data <= _MOST_DATA else None

    @property
    def header(self) -> int:
        return self.count << _LENGTH_BITS | self.data

    @property
    def length(self) -> int:
        """Packets of a block, such that of those that are left enough are left."""
        length = self.data
        while length * _LEFT - _DEVIATIONS * math.sqrt(length * _LEFT * (1 - _LEFT)) < self.data:
            length += 1
        return min(length, reed_solomon.MAX_CHUNKS)

    @property
    def packets(self) -> int:
        return self.count * self.length

    @property
    def size(self) -> int:
        """Bytes of an encrypted payload."""
        return self.count * self.data * PACKET_BYTES

    def encode(self, encrypted: bytes) -> Bytes:
        """[packets, PACKET_BYTES] packet i of block b at i * count + b."""
        rows = np.frombuffer(encrypted, np.uint8).reshape(self.data, -1)
        return reed_solomon.encode(rows, self.length).reshape(-1, PACKET_BYTES)

    def decode(self, numbers: Words, found: Bytes) -> bytes:
        """The encrypted payload. Raises InputError where too few packets are left."""
        inside = numbers < np.uint64(self.packets)
        own, found = numbers[inside].astype(np.int64), found[inside]
        # Two packets with one number: one is there by chance, and both are left out.
        once = np.bincount(own, minlength=self.packets) == 1
        table = np.zeros((self.length, self.count, PACKET_BYTES), np.uint8)
        there = np.zeros((self.length, self.count), bool)
        rows, blocks = np.divmod(own, self.count)
        table[rows, blocks], there[rows, blocks] = found, once[own]
        decoded = np.zeros((self.data, self.count, PACKET_BYTES), np.uint8)
        for block in range(self.count):
            left = {int(row): table[row, block] for row in np.flatnonzero(there[:, block])}
            data = reed_solomon.decode(left, self.data, self.length)
            if data is None:
                raise InputError(
                    "the key is right, but too much of the model was lost or changed since something was "
                    f"hidden in it: {int(there.sum()):,} of {self.packets:,} packets are left"
                )
            decoded[:, block] = data
        return decoded.tobytes()


def _shifts_with_pilots(steps: Doubles, colours: Points) -> Iterator[float]:
    """Of all places where the lattice of log scales may begin those with most pilots among the Gaussians."""
    shifts = all_shifts(steps)
    counts = np.array([pilots.count(invariants_of(colours, scales_at(steps, each))) for each in shifts])
    by_chance = len(steps) / pilots.ONE_IN
    for index in np.argsort(counts)[::-1][:_TRIED]:
        if counts[index] > by_chance + _NOT_BY_CHANCE * math.sqrt(by_chance):
            yield float(shifts[index])


def _words(key: DerivedKey, payload: Payload, random: np.random.Generator) -> Bits:
    """[N, WORD_BITS] header and packets of one secret."""
    packed = _packed(payload)
    blocks = _Blocks.of(compressed_size(packed))
    encrypted = encrypt(key.expand("appended/data", 32), packed, _ASSOCIATED, size=blocks.size)
    header = packets.write_header(key.expand("appended/header", 32), blocks.header, random)
    numbers = np.arange(blocks.packets, dtype=np.uint64)
    return np.concatenate(
        [header, packets.write(key.expand("appended/packets", 32), numbers, blocks.encode(encrypted))]
    )


def _packed(payload: Payload) -> bytes:
    return pack_method(payload.method) + payload.data
