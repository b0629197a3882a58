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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields as dataclass_fields

import numpy as np

from keyss.channels.base import Content, Payload, PayloadChannel, PayloadRoom, PayloadsOnly
from keyss.channels.codes import syndromes
from keyss.channels.codes.fields import FORMATS, Doubles, Field, Flags, Levels, format_of
from keyss.channels.codes.kept import changeable
from keyss.channels.codes.layout import (
    SLOT_BYTES,
    ZONE_RATE,
    Bits,
    Header,
    Order,
    Zones,
    find_header,
    order,
    to_bits,
    to_bytes,
)
from keyss.channels.codes.matching import matched, unrounded
from keyss.channels.codes.order import Counted, in_file_order
from keyss.channels.codes.syndromes import rate_of
from keyss.channels.mixing import random_fractions, random_order, random_words
from keyss.channels.packing import frame_payload, unframe_payload
from keyss.channels.writing import check_keys, randomness
from keyss.core.errors import InputError, UsageError, WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.files.formats.common import CodedGaussians, Codes, in_morton_order, writable
from keyss.keys.derivation import SALT_BYTES, DerivedKey, KeyDerivation, expand, stream
from keyss.keys.encryption import OVERHEAD, compressed_size, decrypt, encrypt

_ASSOCIATED = b"keyss/v1/codes/data"
_ATTEMPTS = 100  # orders of blocks to try; fewer than one in ten fails
_USUAL_RATE = 800  # of a key that opens nothing
_BITS_PER_GAUSSIAN = 18  # about, of room
_OVERHEAD = 128  # bytes of a payload beside its data, at most


@dataclass(frozen=True)
class CodesChannel(PayloadChannel):
    """The channel in the codes of one format; see `keyss.channels.base.Channel`."""

    format: str  # spz, sog or compressed-ply

    name = "codes"
    survives = False

    @property
    def place(self) -> str:
        return f"codes of the {self.format} file"

    def prepare(self, cover: Gaussians) -> CodesCover:
        """The room in the codes of a model; of a file's model of this format, in those of the file."""
        format_ = FORMATS[self.format]
        if isinstance(cover, CodedGaussians) and format_of(cover.codes) is format_:
            return CodesCover.of(cover.codes)
        model = writable(cover)
        model = in_morton_order(model) if format_.sorts else model.detach().to("cpu")
        return CodesCover.of(format_.quantise(model), model)

    def room(self, gaussians: int, sh_degree: int) -> PayloadRoom:
        return PayloadRoom(gaussians, gaussians * _BITS_PER_GAUSSIAN // 8, _OVERHEAD)

    def reader(self, stego: Gaussians) -> CodesReader | None:
        """Of codes of any format."""
        return CodesReader.of(stego.codes) if isinstance(stego, CodedGaussians) else None


@dataclass(frozen=True)
class CodesCover(PayloadsOnly):
    """Codes whose room is known; see `keyss.channels.base.PreparedCover`."""

    codes: Codes  # in the order in which bits are counted
    fields: list[Field]
    free: list[Flags]  # of each field, which levels may be changed
    near: Mapping[str, Doubles]  # levels before rounding, of the attributes for which they are known
    overhead = _OVERHEAD

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
    def room(self) -> Zones:
        return Zones.of(self.fields)

    @property
    def rate(self) -> int:
        """Bits that a block holds."""
        return rate_of(float(np.mean(self._dry())) if self.room.bits else 0.0)

    @property
    def size(self) -> int:
        """Bytes that all secrets together may take when they are encrypted."""
        return self.room.data_blocks * self.rate // 8

    @property
    def capacity(self) -> int:
        return int(self.size * (1 - 2**-10))  # data that are compressed already get longer by less

    @property
    def cover(self) -> CodedGaussians:
        return _model_of(self.codes)

    @property
    def carriers(self) -> int:
        return len(self.fields[0].levels)

    def embed(
        self, contents: Sequence[tuple[str, Content]], *, entropy: bytes | None = None
    ) -> CodedGaussians:
        """See `PreparedCover`. Raises UsageError for more secrets than there are slots, too."""
        packed = [frame_payload(content) for _, content in contents]
        mixed = randomness(entropy, _digest(self.codes), *packed)
        for attempt in range(_ATTEMPTS):
            own = expand(mixed, f"codes/attempt/{attempt}", 32)
            derivation = KeyDerivation(salt=expand(own, "codes/salt", SALT_BYTES))
            keys = [DerivedKey(key, derivation) for key, _ in contents]
            check_keys([key.verifier() for key in keys])
            found = self._embedded(list(zip(keys, packed, strict=True)), own)
            if found is not None:
                return _model_of(found)
        raise RuntimeError("no block order was found in which all blocks have room")

    def _embedded(self, secrets: Sequence[tuple[DerivedKey, bytes]], entropy: bytes) -> Codes | None:
        """None where, once in a hundred times, a block has too few bits that may change."""
        room, sizes = self.room, [compressed_size(packed) + OVERHEAD for _, packed in secrets]
        if len(secrets) > room.slots:
            raise UsageError(f"this cover has room for {room.slots} secrets, got {len(secrets)}")
        if sum(sizes) > self.size:
            raise UsageError(
                f"the secrets take {sum(sizes):,} bytes, and this cover of {self.carriers:,} Gaussians has "
                f"room for {self.size:,}"
            )
        salt = expand(entropy, "codes/salt", SALT_BYTES)
        zone = bytearray(salt + stream(entropy, "codes/slots", room.slots * SLOT_BYTES))
        data = _noise(entropy, "codes/noise", room.data_blocks * self.rate)
        starts = _starts(sizes, len(data), entropy)
        slots = random_order(entropy, "codes/slot-order", room.slots).tolist()
        for (key, packed), size, start, slot in zip(secrets, sizes, starts, slots, strict=False):
            at = SALT_BYTES + slot * SLOT_BYTES
            zone[at : at + SLOT_BYTES] = Header(self.rate, start, size).encrypt(key, slot)
            encrypted = encrypt(_data_key(key), packed, _ASSOCIATED, size=size)
            data[_range(len(data), start, size)] = to_bits(encrypted)
        bits = self._solved(to_bits(bytes(zone)), data, salt, entropy)
        if bits is None:
            return None
        within = random_fractions(entropy, "codes/file-order", 3 * self.carriers).reshape(-1, 3) - 0.5
        sorted_again: Codes = in_file_order(self._written(bits, entropy), within)
        return sorted_again

    def _solved(self, zone: Bits, data: Bits, salt: bytes, entropy: bytes) -> Bits | None:
        """The last bits of all levels; those that may change are random."""
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
                + random_fractions(entropy, f"codes/ties/{field.name}/{field.column}", len(free))
                - 0.5
            )
            found = matched(field.levels, field.residues(own), field.bits, near)
            columns.setdefault(field.name, []).append(np.where(free, found, field.levels))
        levels = {name: np.stack(each, axis=1) for name, each in columns.items()}
        written: Codes = format_of(self.codes).with_levels(self.codes, levels)
        return written


@dataclass(frozen=True)
class CodesReader:
    """Codes as a reader sees them."""

    room: Zones
    bits: Bits  # the last ones of all levels
    zone: bytes  # salt and slots

    @staticmethod
    def of(codes: Codes) -> CodesReader | None:
        """None for codes that have no room for anything. Raises InputError for other formats."""
        fields = Counted.of(codes).fields
        room = Zones.of(fields)
        if not room.slots:
            return None
        bits = _last_bits(fields)
        first = room.zone_order()[: room.zone_bits]
        zone = to_bytes(syndromes.read(bits[first], syndromes.matrix(bytes(SALT_BYTES), ZONE_RATE)))
        return CodesReader(room, bits, zone[: SALT_BYTES + room.slots * SLOT_BYTES])

    @property
    def salts(self) -> list[bytes]:
        return [self.zone[:SALT_BYTES]]

    def open(self, key: str) -> Payload:
        """What `key` opens. Raises WrongKeyError, and InputError for what is damaged."""
        return self.extract(DerivedKey(key, KeyDerivation(salt=self.salts[0])))

    def extract(self, key: DerivedKey) -> Payload:
        """`open` after key derivation. A key that opens nothing makes the same passes."""
        header = find_header(self.zone, key, self.room)
        rate = header.rate if header else _USUAL_RATE
        _, places = _places(self.room, self.salts[0])
        data = syndromes.read(self.bits[places], _matrices(self.salts[0], rate)[1])
        start, size = (header.start, header.size) if header else (0, len(data) // 8)
        encrypted = to_bytes(data[_range(len(data), start, size)])
        try:
            return unframe_payload(decrypt(_data_key(key), encrypted, _ASSOCIATED))
        except (InputError, ValueError) as error:
            if header is None:
                raise WrongKeyError() from None
            raise InputError(f"the encrypted data are damaged: {error}") from error


def _model_of(codes: Codes) -> CodedGaussians:
    """The model that codes stand for, with them."""
    return CodedGaussians.of(format_of(codes).dequantise(codes), codes)


def _data_key(key: DerivedKey) -> bytes:
    return key.expand("codes/data", 32)


def _last_bits(fields: Sequence[Field]) -> Bits:
    return np.concatenate([each.read() for each in fields])


def _places(room: Zones, salt: bytes) -> tuple[Order, Order]:
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
    *gaps, offset = random_words(entropy, "codes/gaps", len(sizes) + 1).tolist()
    free = room - 8 * sum(sizes)
    before = np.diff(sorted(gap % (free + 1) for gap in gaps), prepend=0).tolist()
    starts = [0] * len(sizes)
    along = random_order(entropy, "codes/along", len(sizes)).tolist()
    for gap, index in zip(before, along, strict=True):
        starts[index] = (offset + gap) % room
        offset += gap + 8 * sizes[index]
    return starts


def _noise(entropy: bytes, label: str, count: int) -> Bits:
    """[count] random bits."""
    return to_bits(stream(entropy, label, -(-count // 8)))[:count]


def _digest(codes: Codes) -> bytes:
    state = hashlib.sha256()
    for each in dataclass_fields(codes):  # type: ignore[arg-type]
        value = getattr(codes, each.name)
        state.update(value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode())
    return state.digest()
