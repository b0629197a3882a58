"""Secrets in the last bits of the codes of a final .spz, .sog or compressed .ply.

The file is passed on byte for byte, so values are exact and nothing is redundant. Which numbers carry is in
`fields`, where what lies in `layout`. Every usable bit of the fields in use is written, with noise where
there is no secret: files with one secret and with many look alike. All randomness comes from `entropy`, mixed
with the cover and all payloads, so that no two files have a salt in common; and what encrypts is derived from
key and salt, so that no key stream is used twice.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from dataclasses import fields as dataclass_fields
from itertools import combinations

import numpy as np
import numpy.typing as npt

from keyss.channels.base import METHOD_BYTES, Payload, pack_method, unpack_method
from keyss.channels.codes.fields import Field, Levels, format_of
from keyss.channels.codes.layout import (
    SLOT_BYTES,
    Bits,
    Header,
    Room,
    find_header,
    order,
    to_bits,
    to_bytes,
)
from keyss.channels.codes.matching import matched
from keyss.channels.codes.natural import is_natural
from keyss.channels.codes.order import Counted, in_file_order
from keyss.channels.codes.rotations import kept_smaller
from keyss.channels.codes.unrounded import Doubles, unrounded
from keyss.core.errors import InputError, UsageError, WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.files.formats.common import Codes
from keyss.keys.derivation import SALT_BYTES, DerivedKey, KeyDerivation, expand, stream
from keyss.keys.encryption import OVERHEAD, compressed_size, decrypt, encrypt

_ASSOCIATED = b"keyss/v1/codes/data"
_OPENS_NOTHING = "this key opens nothing here"


@dataclass(frozen=True)
class CodesCover:
    """Codes whose room is known."""

    codes: Codes  # in the order in which bits are counted
    fields: list[Field]
    carrying: int  # bit i: field i carries
    near: Mapping[str, Doubles]  # levels before rounding, of the fields for which they are known

    @staticmethod
    def of(codes: Codes, model: Gaussians | None = None) -> CodesCover:
        """`model`: what was quantised to the codes, Gaussian by Gaussian, if the writer has it.

        Fields that are not as training leaves them do not carry, but for the headers in the first one. Raises
        InputError for codes that have no room.
        """
        near = {} if model is None else unrounded(model, codes)
        counted = Counted.of(codes)
        if not Room.of(counted.fields).slots:
            raise InputError(
                f"a model of {len(counted.rows):,} Gaussians has no room for secrets in the codes of "
                f"{format_of(codes).name} files"
            )
        carrying = sum(1 << index for index, each in enumerate(counted.fields) if is_natural(each))
        near = {name: each[counted.rows] for name, each in near.items()}
        return CodesCover(counted.codes, counted.fields, carrying, near)

    @property
    def room(self) -> Room:
        return Room.of(self.fields)

    @property
    def capacity(self) -> int:
        """Bytes that all secrets together may take, each `payload_size` of its payload."""
        return self.room.data_bits(self.carrying) // 8

    def embed(self, secrets: Sequence[tuple[str, Payload]], *, entropy: bytes | None = None) -> Codes:
        """The codes with one (key, payload) for each secret. Takes 0.1 s a secret for key derivation.

        `entropy`: at least 32 bytes that nobody else can know; by default the system's. Raises UsageError for
        equal keys, for none, for more than there are slots, and for what does not fit.
        """
        mixed = self._mixed(entropy, [payload for _, payload in secrets])
        derivation = KeyDerivation(salt=expand(mixed, "codes/salt", SALT_BYTES))
        return self._embedded([(DerivedKey(key, derivation), each) for key, each in secrets], mixed)

    def _embedded(self, secrets: Sequence[tuple[DerivedKey, Payload]], entropy: bytes) -> Codes:
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
        data = _noise(entropy, room.data_bits(self.carrying))
        places, starts = order(salt, len(data)), _starts(sizes, len(data), entropy)
        slots = np.argsort(_words(entropy, "codes/slot-order", room.slots), kind="stable").tolist()
        for (key, payload), size, start, slot in zip(secrets, sizes, starts, slots, strict=False):
            at = SALT_BYTES + slot * SLOT_BYTES
            zone[at : at + SLOT_BYTES] = Header(self.carrying, start, size).encrypt(key, slot)
            encrypted = encrypt(_data_key(key), _packed(payload), _ASSOCIATED, size=size)
            data[_range(places, start, size)] = to_bits(encrypted)
        written = self._written(np.concatenate([to_bits(bytes(zone)), data]), entropy)
        random = _words(entropy, "codes/file-order", 3 * len(self.fields[0].levels))
        sorted_again: Codes = in_file_order(written, _halves(random).reshape(-1, 3))
        return sorted_again

    def _written(self, bits: Bits, entropy: bytes) -> Codes:
        columns: dict[str, list[Levels]] = {}
        for field in self.fields:
            columns.setdefault(field.name, []).append(field.levels.copy())
        for field in self._written_fields():
            own, bits = bits[: field.room], bits[field.room :]
            residues = own.reshape(-1, field.bits) @ (1 << np.arange(field.bits, dtype=np.int32))
            old, low, high = (each[field.usable] for each in (field.levels, field.low, field.high))
            if field.name in self.near:
                near = self.near[field.name][field.usable, field.column]
            else:
                near = old + _halves(_words(entropy, f"codes/ties/{field.name}/{field.column}", len(old)))
            found = matched(old, residues.astype(np.int32), field.bits, low, high, near)
            columns[field.name][field.column][field.usable] = found
        levels = {name: np.stack(each, axis=1) for name, each in columns.items()}
        levels["rotations"] = self._with_largest(levels["rotations"])
        written: Codes = format_of(self.codes).with_levels(self.codes, levels)
        return written

    def _with_largest(self, rotations: Levels) -> Levels:
        """[N, 3] written levels of rotations, with no more parts than before larger than what is left out."""
        turns = format_of(self.codes).turns(self.codes)
        own = [each for each in self.fields if each.name == "rotations"]
        before, usable = (
            np.stack(each, axis=1) for each in zip(*((f.levels, f.usable) for f in own), strict=True)
        )
        return rotations if turns is None else kept_smaller(before, rotations, usable, own[0].bits, *turns)

    def _written_fields(self) -> list[Field]:
        """The fields that carry; of the first one, if it does not, the levels of salt and headers."""
        first, *others = self.fields
        if not self.carrying & 1:
            levels = self.room.zone_bits // first.bits
            first = replace(first, usable=first.usable & (np.cumsum(first.usable) <= levels))
        return [first, *(each for i, each in enumerate(others, 1) if self.carrying >> i & 1)]

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
    bits: list[Bits]  # of each field
    zone: bytes  # salt and slots

    @staticmethod
    def of(codes: Codes) -> CodesReader:
        """Raises WrongKeyError for codes that have no room for anything, and InputError for other formats."""
        fields = Counted.of(codes).fields
        room = Room.of(fields)
        if not room.slots:
            raise WrongKeyError(_OPENS_NOTHING)
        bits = [_read(each) for each in fields]
        return CodesReader(room, bits, to_bytes(bits[0][: room.zone_bits]))

    @property
    def salt(self) -> bytes:
        return self.zone[:SALT_BYTES]

    def open(self, key: str) -> Payload:
        """What `key` opens. Raises WrongKeyError, and InputError for what is damaged."""
        return self.extract(DerivedKey(key, KeyDerivation(salt=self.salt)))

    def extract(self, key: DerivedKey) -> Payload:
        """`open` after key derivation. A key that opens nothing makes the same passes."""
        header = find_header(self.zone, key, self.room)
        carrying = header.fields if header else (1 << len(self.bits)) - 1
        first = self.bits[0][self.room.zone_bits :]
        own = [bits for i, bits in enumerate([first, *self.bits[1:]]) if carrying >> i & 1]
        data = np.concatenate(own)
        places = order(self.salt, len(data))
        start, size = (header.start, header.size) if header else (0, len(data) // 8)
        encrypted = to_bytes(data[_range(places, start, size)])
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


def _read(field: Field) -> Bits:
    """The bits of the usable levels of a field."""
    residues = field.levels[field.usable]
    found: Bits = (residues[:, None] >> np.arange(field.bits, dtype=np.int32) & 1).astype(np.uint8)
    return found.reshape(-1)


def _range(places: npt.NDArray[np.int64], start: int, size: int) -> npt.NDArray[np.int64]:
    """`size` bytes of places from `start` on, and on from the first after the last."""
    return np.concatenate(
        [places[start : start + 8 * size], places[: max(0, start + 8 * size - len(places))]]
    )


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


def _noise(entropy: bytes, count: int) -> Bits:
    """[count] random bits."""
    return to_bits(stream(entropy, "codes/noise", -(-count // 8)))[:count]


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
