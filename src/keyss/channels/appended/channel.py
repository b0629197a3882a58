"""Secrets in appended Gaussians.

A payload is encrypted as a whole (ChaCha20-Poly1305 under a key that Argon2id gives with the file's salt),
cut into packets, and given parity by Reed-Solomon, each block of at most 255 packets for itself: any 150 of
them give it back. Every packet is a Gaussian. A header tells how many blocks there are and how long they are.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

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
from keyss.channels.base import METHOD_BYTES, Content, Payload, PayloadChannel, PayloadRoom, PayloadsOnly
from keyss.channels.packing import frame_payload, unframe_payload
from keyss.channels.writing import check_keys, randomness
from keyss.core.errors import InputError, KeyssWarning, UsageError, WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.keys.derivation import SALT_BYTES, DerivedKey, KeyDerivation, expand, stream
from keyss.keys.encryption import OVERHEAD, compressed_size, decrypt, encrypt

_LENGTH_BITS = 8  # of the packets of a block that hold data
_MAX_DATA = 150  # packets of a block that hold data
_MAX_BLOCKS = min(1 << NUMBER_BITS - _LENGTH_BITS, (1 << NUMBER_BITS) // reed_solomon.MAX_CHUNKS) - 1
# A quarter of the packets may be lost, and of the others what formats garble, with so many deviations more.
_LEFT, _DEVIATIONS = 0.72, 4.5
MAX_BYTES = _MAX_BLOCKS * _MAX_DATA * PACKET_BYTES - OVERHEAD - METHOD_BYTES
_OVERHEAD = 128  # bytes of a payload beside its data, at most

# Gaussians in which pilots are counted; places of the lattice that are tried then, with so many deviations
# more of them than by chance.
_SAMPLE, _TRIED, _NOT_BY_CHANCE = 8000, 8, 3.0
_ASSOCIATED = b"keyss/v1/appended/data"
_NOTICED = (
    "the number of appended Gaussians tells how much is hidden in all: whoever holds one of the keys sees "
    "that there are other secrets"
)


class Appended(PayloadChannel):
    """The channel; see `keyss.channels.base.Channel`."""

    name = "appended"
    place = "appended Gaussians"
    survives = True
    grows = True

    def prepare(self, cover: Gaussians) -> AppendedCover:
        return AppendedCover(cover)

    def room(self, gaussians: int, sh_degree: int) -> PayloadRoom:
        return PayloadRoom(gaussians, MAX_BYTES, _OVERHEAD, True)

    def appended(self, size: int) -> int:
        """For `size` compressed bytes, alone in a model."""
        own = packets.HEADERS + _Blocks.of(size).packets
        return own + pilots.count_for(own)

    def reader(self, stego: Gaussians) -> AppendedReader | None:
        return AppendedReader.of(stego)


APPENDED = Appended()


@dataclass(frozen=True)
class AppendedCover(PayloadsOnly):
    """A cover, whichever it is; see `keyss.channels.base.PreparedCover`."""

    cover: Gaussians
    capacity = MAX_BYTES
    overhead = _OVERHEAD
    grows = True

    @property
    def carriers(self) -> int:
        return len(self.cover)

    def embed(self, contents: Sequence[tuple[str, Content]], *, entropy: bytes | None = None) -> Gaussians:
        """The cover with Gaussians after its own. Warns where there is more than one secret."""
        packed = [frame_payload(content) for _, content in contents]
        secret = randomness(entropy, *packed)
        salt = expand(secret, "appended/salt", SALT_BYTES)
        random = np.random.default_rng(np.frombuffer(stream(secret, "appended/random", 32), np.uint32))
        keys = [DerivedKey(key, KeyDerivation(salt=salt)) for key, _ in contents]
        check_keys([key.verifier() for key in keys])
        if len(keys) > 1:
            warnings.warn(_NOTICED, KeyssWarning, stacklevel=2)
        words = [_words(*each, random) for each in zip(keys, packed, strict=True)]
        words.append(pilots.write(salt, pilots.count_for(sum(map(len, words))), random))
        every = np.concatenate(words)[random.permutation(sum(map(len, words)))]
        model = self.cover.detach().to("cpu")
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
        if candidates.sum() < pilots.MIN // 4:
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

    @property
    def salts(self) -> list[bytes]:
        return [self.salt]

    def open(self, key: str) -> Payload:
        """What `key` opens. Raises WrongKeyError, and InputError where too much was lost or changed."""
        return self.extract(DerivedKey(key, KeyDerivation(salt=self.salt)))

    def extract(self, key: DerivedKey) -> Payload:
        """`open` after key derivation."""
        header = packets.read_header(key.expand("appended/header", 32), self.words)
        blocks = header and _Blocks.of_header(header)
        if not blocks:
            raise WrongKeyError()
        numbers, data = packets.read(key.expand("appended/packets", 32), self.words)
        try:
            plain = decrypt(key.expand("appended/data", 32), blocks.decode(numbers, data), _ASSOCIATED)
            return unframe_payload(plain)
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
        count = -(-needed // _MAX_DATA)
        if count > _MAX_BLOCKS:
            raise UsageError(f"the secret takes {size:,} bytes, and {MAX_BYTES:,} can be appended")
        return _Blocks(count, -(-needed // count))

    @staticmethod
    def of_header(header: int) -> _Blocks | None:
        count, data = header >> _LENGTH_BITS, header & (1 << _LENGTH_BITS) - 1
        return _Blocks(count, data) if 0 < count <= _MAX_BLOCKS and 0 < data <= _MAX_DATA else None

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


def _words(key: DerivedKey, packed: bytes, random: np.random.Generator) -> Bits:
    """[N, WORD_BITS] header and packets of one secret."""
    blocks = _Blocks.of(compressed_size(packed))
    encrypted = encrypt(key.expand("appended/data", 32), packed, _ASSOCIATED, size=blocks.size)
    header = packets.write_header(key.expand("appended/header", 32), blocks.header, random)
    numbers = np.arange(blocks.packets, dtype=np.uint64)
    return np.concatenate(
        [header, packets.write(key.expand("appended/packets", 32), numbers, blocks.encode(encrypted))]
    )
