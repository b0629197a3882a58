"""Secrets in the last bits of the codes of a final .spz, .sog or compressed .ply.

The file is passed on byte for byte, so values are exact and nothing is redundant. Which numbers carry is in
`fields`, which of these are left alone in `kept`, how readers do without knowing that in `syndromes`, where
what lies in `layout`. Every other bit is random afterwards, whatever is hidden: files with one secret and
with many look alike. All randomness comes from `entropy`, mixed with the cover and all payloads, so that no
two files have a salt in common; and what encrypts is derived from key and salt, so that no key stream is
used twice.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from dataclasses import fields as dataclass_fields
from itertools import combinations

import numpy as np
import numpy.typing as npt

from keyss.channels.base import METHOD_BYTES, Payload, pack_method, unpack_method
from keyss.channels.codes import syndromes
from keyss.channels.codes.fields import Doubles, Field, Flags, Levels, format_of
from keyss.channels.codes.kept import changeable
from keyss.channels.codes.layout import (
    SLOT_BYTES,
    ZONE_RATE,
    Bits,
    Header,
    Order,
    Room,
    find_header,
    order,
    to_bits,
    to_bytes,
)
from keyss.channels.codes.matching import matched
from keyss.channels.codes.order import Counted, in_file_order
from keyss.channels.codes.syndromes import rate_of
from keyss.channels.codes.unrounded import unrounded
from keyss.core.errors import InputError, UsageError, WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.files.formats.common import Codes
from keyss.keys.derivation import SALT_BYTES, DerivedKey, KeyDerivation, expand, stream
from keyss.keys.encryption import OVERHEAD, compressed_size, decrypt, encrypt

_ASSOCIATED = b"keyss/v1/codes/data"
_ATTEMPTS = 100  # orders of blocks to be tried, of which hardly one in ten fails
_USUAL_RATE = 800  # of a key that opens nothing
_OPENS_NOTHING = "this key opens nothing here"


@dataclass(frozen=True)
class CodesCover:
    """Codes whose room is known."""

    codes: Codes  # in the order in which bits are counted
    fields: list[Field]
    free: list[Flags]  # of each field, which levels may be changed
    near: Mapping[str, Doubles]  # levels before rounding, of the attributes for which they are known

    @staticmethod
    def of(codes: Codes, model: Gaussians | None = None) -> CodesCover:
        """`model`: what was quantised to the codes, Gaussian by Gaussian, if the writer has it.

        Raises InputError for codes that have no room.
        """
        near = {} if model is None else unrounded(model, codes)
        counted = Counted.of(codes)
        near = {name: each[counted.rows] for name, each in near.items()}
        free = changeable(counted.codes, counted.fields, _digest(codes))
        found = CodesCover(counted.codes, counted.fields, free, near)
        if not found.room.slots or found.rate < ZONE_RATE:
            raise InputError(
                f"a model of {len(counted.rows):,} Gaussians has no room for secrets in the codes of "
                f"{format_of(codes).name} files"
            )
        return found

    @property
    def room(self) -> Room:
        return Room.of(self.fields)

    @property
    def rate(self) -> int:
        """Bits that a block holds."""
        return rate_of(float(np.mean(self._dry())) if self.room.bits else 0.0)

    @property
    def capacity(self) -> int:
        """Bytes that all secrets together may take, each `payload_size` of its payload."""
        return self.room.data_blocks * self.rate // 8

    def embed(self, secrets: Sequence[tuple[str, Payload]], *, entropy: bytes | None = None) -> Codes:
        """The codes with one (key, payload) for each secret. Takes 0.1 s a secret for key derivation.

        `entropy`: at least 32 bytes that nobody else can know; by default the system's. Raises UsageError for
        equal keys, for none, for more than there are slots, and for what does not fit.
        """
        mixed = self._mixed(entropy, [payload for _, payload in secrets])
        for attempt in range(_ATTEMPTS):
            own = expand(mixed, f"codes/attempt/{attempt}", 32)
            derivation = KeyDerivation(salt=expand(own, "codes/salt", SALT_BYTES))
            found = self._embedded([(DerivedKey(key, derivation), each) for key, each in secrets], own)
            if found is not None:
                return found
        raise RuntimeError("no block order was found in which all blocks have room")

    def _embedded(self, secrets: Sequence[tuple[DerivedKey, Payload]], entropy: bytes) -> Codes | None:
        """None where, once in a hundred times, a block has too few bits that may change."""
        keys = [key for key, _ in secrets]
        if not keys or any(a.equals(b) for a, b in combinations(keys, 2)):
            raise UsageError("two secrets have the same key: expected at least one secret, each with its own")
        room, sizes = self.room, [payload_size(payload) for _, payload in secrets]
        if len(secrets) > room.slots:
            raise UsageError(f"this cover has room for {room.slots} secrets, got {len(secrets)}")
        if sum(sizes) > self.capacity:
            raise UsageError(
                f"the secrets take {sum(sizes):,} bytes, and this cover of {len(self.fields[0].levels):,} "
                f"Gaussians has room for {self.capacity:,}"
            )
        salt = expand(entropy, "codes/salt", SALT_BYTES)
        zone = bytearray(salt + stream(entropy, "codes/slots", room.slots * SLOT_BYTES))
        data = _noise(entropy, "codes/noise", room.data_blocks * self.rate)
        starts = _starts(sizes, len(data), entropy)
        slots = np.argsort(_words(entropy, "codes/slot-order", room.slots), kind="stable").tolist()
        for (key, payload), size, start, slot in zip(secrets, sizes, starts, slots, strict=False):
            at = SALT_BYTES + slot * SLOT_BYTES
            zone[at : at + SLOT_BYTES] = Header(self.rate, start, size).encrypt(key, slot)
            encrypted = encrypt(_data_key(key), _packed(payload), _ASSOCIATED, size=size)
            data[_range(len(data), start, size)] = to_bits(encrypted)
        bits = self._solved(to_bits(bytes(zone)), data, salt, entropy)
        if bits is None:
            return None
        random = _words(entropy, "codes/file-order", 3 * len(self.fields[0].levels))
        sorted_again: Codes = in_file_order(self._written(bits, entropy), _halves(random).reshape(-1, 3))
        return sorted_again

    def _solved(self, zone: Bits, data: Bits, salt: bytes, entropy: bytes) -> Bits | None:
        """The last bits of all levels, of which those that may change are random."""
        room, dry = self.room, self._dry()
        bits = np.where(dry, _noise(entropy, "codes/free", room.bits), _last_bits(self.fields))
        zone = np.append(zone, _noise(entropy, "codes/zone", -len(zone) % ZONE_RATE))
        for places, message, rows in zip(
            _places(room, salt), (zone, data), _matrices(salt, self.rate), strict=True
        ):
            found = syndromes.write(bits[places], dry[places], message, rows)
            if found is None:
                return None
            bits[places] = found
        return bits

    def _dry(self) -> Bits:
        """[room.bits] 1 where a bit may be changed."""
        parts = [np.repeat(free, each.bits) for free, each in zip(self.free, self.fields, strict=True)]
        return np.concatenate(parts).astype(np.uint8)

    def _written(self, bits: Bits, entropy: bytes) -> Codes:
        columns: dict[str, list[Levels]] = {}
        for field, free in zip(self.fields, self.free, strict=True):
            own, bits = bits[: field.room], bits[field.room :]
            near = (
                self.near[field.name][:, field.column]
                if field.name in self.near
                else field.levels
                + _halves(_words(entropy, f"codes/ties/{field.name}/{field.column}", len(free)))
            )
            found = matched(field.levels, field.residues(own), field.bits, near)
            columns.setdefault(field.name, []).append(np.where(free, found, field.levels))
        levels = {name: np.stack(each, axis=1) for name, each in columns.items()}
        written: Codes = format_of(self.codes).with_levels(self.codes, levels)
        return written

    def _mixed(self, entropy: bytes | None, payloads: Sequence[Payload]) -> bytes:
        """32 bytes that depend on all of it: from equal ones two files would get one salt."""
        entropy = os.urandom(32) if entropy is None else entropy
        if len(entropy) < 32:
            raise ValueError(f"expected at least 32 bytes of entropy, got {len(entropy)}")
        parts = [entropy, _digest(self.codes), *(_packed(each) for each in payloads)]
        return hashlib.sha256(b"".join(hashlib.sha256(each).digest() for each in parts)).digest()


@dataclass(frozen=True)
class CodesReader:
    """Codes as a reader sees them."""

    room: Room
    bits: Bits  # the last ones of all levels
    zone: bytes  # salt and slots

    @staticmethod
    def of(codes: Codes) -> CodesReader:
        """Raises WrongKeyError for codes that have no room for anything, and InputError for other formats."""
        fields = Counted.of(codes).fields
        room = Room.of(fields)
        if not room.slots:
            raise WrongKeyError(_OPENS_NOTHING)
        bits = _last_bits(fields)
        first = room.zone_order()[: room.zone_bits]
        zone = to_bytes(syndromes.read(bits[first], syndromes.matrix(bytes(SALT_BYTES), ZONE_RATE)))
        return CodesReader(room, bits, zone[: SALT_BYTES + room.slots * SLOT_BYTES])

    @property
    def salt(self) -> bytes:
        return self.zone[:SALT_BYTES]

    def open(self, key: str) -> Payload:
        """What `key` opens. Raises WrongKeyError, and InputError for what is damaged."""
        return self.extract(DerivedKey(key, KeyDerivation(salt=self.salt)))

    def extract(self, key: DerivedKey) -> Payload:
        """`open` after key derivation. A key that opens nothing makes the same passes."""
        header = find_header(self.zone, key, self.room)
        rate = header.rate if header else _USUAL_RATE
        _, places = _places(self.room, self.salt)
        data = syndromes.read(self.bits[places], _matrices(self.salt, rate)[1])
        start, size = (header.start, header.size) if header else (0, len(data) // 8)
        encrypted = to_bytes(data[_range(len(data), start, size)])
        try:
            plain = decrypt(_data_key(key), encrypted, _ASSOCIATED)
            return Payload(unpack_method(plain), plain[METHOD_BYTES:])
        except (InputError, ValueError) as error:
            if header is None:
                raise WrongKeyError(_OPENS_NOTHING) from None
            raise InputError(f"the encrypted data are damaged: {error}") from error


def payload_size(payload: Payload) -> int:
    """Bytes that a payload takes."""
    return compressed_size(_packed(payload)) + OVERHEAD


def _packed(payload: Payload) -> bytes:
    return pack_method(payload.method) + payload.data


def _data_key(key: DerivedKey) -> bytes:
    return key.expand("codes/data", 32)


def _last_bits(fields: Sequence[Field]) -> Bits:
    return np.concatenate([each.read() for each in fields])


def _places(room: Room, salt: bytes) -> tuple[Order, Order]:
    """The bits of salt and slots, and those of data, in the order in which blocks take them."""
    every = room.zone_order()
    zone, others = np.split(every, [room.zone_bits])
    return zone, others[order(salt, len(others))][: room.data_blocks * syndromes.BLOCK]


def _matrices(salt: bytes, rate: int) -> tuple[syndromes.Words, syndromes.Words]:
    """Of the blocks of salt and slots, and of those of data."""
    return syndromes.matrix(bytes(SALT_BYTES), ZONE_RATE), syndromes.matrix(salt + bytes(16), rate)


def _range(count: int, start: int, size: int) -> Order:
    """`size` bytes from bit `start` on, of `count` bits that go on at the start where they end."""
    return (start + np.arange(8 * size)) % count


def _starts(sizes: Sequence[int], room: int, entropy: bytes) -> list[int]:
    """First bits of ranges of `sizes` bytes in a circle of `room` bits: all arrangements alike."""
    *gaps, offset = _words(entropy, "codes/gaps", len(sizes) + 1).tolist()
    free = room - 8 * sum(sizes)
    before = np.diff(sorted(gap % (free + 1) for gap in gaps), prepend=0).tolist()
    starts = [0] * len(sizes)
    along = np.argsort(_words(entropy, "codes/along", len(sizes)), kind="stable").tolist()
    for gap, index in zip(before, along, strict=True):
        starts[index] = (offset + gap) % room
        offset += gap + 8 * sizes[index]
    return starts


def _noise(entropy: bytes, label: str, count: int) -> Bits:
    """[count] random bits."""
    return to_bits(stream(entropy, label, -(-count // 8)))[:count]


def _words(entropy: bytes, label: str, count: int) -> npt.NDArray[np.uint64]:
    """[count] random integers."""
    return np.frombuffer(stream(entropy, label, 8 * count), "<u8")


def _halves(words: npt.NDArray[np.uint64]) -> Doubles:
    """Random numbers from -1/2 to 1/2, without the ends."""
    found: Doubles = ((words >> np.uint64(12)).astype(np.float64) + 0.5) / 2.0**52 - 0.5
    return found


def _digest(codes: Codes) -> bytes:
    state = hashlib.sha256()
    for each in dataclass_fields(codes):  # type: ignore[arg-type]
        value = getattr(codes, each.name)
        state.update(value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode())
    return state.digest()
