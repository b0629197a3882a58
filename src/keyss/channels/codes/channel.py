"""Secrets in the last bits of the codes of a .spz, .sog or compressed .ply, or of a .ply decoded from one.

The file is passed on byte for byte, so values are exact and nothing is redundant. `fields` chooses the
numbers that carry bits, `kept` those that are left alone, `syndromes` lets readers do without that list, and
`layout` assigns places. Every other bit is random: files with one secret and with many look alike. All
randomness comes from `entropy`, mixed with the cover and all payloads, so that no two files share a salt;
encryption keys derive from key and salt, so that no key stream is used twice.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, fields as dataclass_fields, replace
from functools import cached_property

import numpy as np
import torch

from keyss.channels.base import (
    Channel,
    Content,
    Payload,
    Room,
    SaltedReader,
    check_keys,
    pack_payload,
    randomness,
    unpack_payload,
)
from keyss.channels.codes import syndromes
from keyss.channels.codes.decoded import Decoded
from keyss.channels.codes.fields import FORMATS, Field, Levels, carrying
from keyss.channels.codes.kept import changeable, counted_order, file_order, in_counted_order, in_rows
from keyss.channels.codes.layout import SLOT_BYTES, ZONE_RATE, Header, Zones, find_header, to_bits, to_bytes
from keyss.channels.codes.syndromes import rate_of
from keyss.channels.mixing import random_fractions, random_order, random_words
from keyss.core.arrays import Bits, Flags, Integers, Words
from keyss.core.errors import InputError, UsageError, WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.files.formats.common import CodedGaussians, Codes
from keyss.keys.derivation import SALT_BYTES, DerivedKey, expand, stream
from keyss.keys.encryption import OVERHEAD, compressed_size, decrypt, encrypt

_ASSOCIATED = b"keyss/v1/codes/data"
_ATTEMPTS = 100  # orders of blocks to try; fewer than one in ten fails
_USUAL_RATE = 800  # of a key that opens nothing
_BITS_PER_GAUSSIAN = 18  # of room, about
_LAST_BITS = {"spz": 29, "sog": 32, "compressed-ply": 26}  # of the levels of a Gaussian, about
_OVERHEAD = 128  # bytes of a payload beside its data, at most


class CodesChannel(Channel):
    """The channel in the codes of one format, `spz`, `sog` or `compressed-ply`."""

    name = "codes"

    def __init__(self, format: str) -> None:
        self.format = format
        self.place = f"codes of the {format} file"

    def prepare(self, cover: Gaussians) -> CodesCover:
        """The room in the codes of a model; a model read from a file of this format keeps its codes."""
        return CodesCover.of(FORMATS[self.format].of(cover))

    def room(self, gaussians: int, sh_degree: int) -> Room:
        slots = Zones(gaussians * _LAST_BITS[self.format]).slots
        return Room(gaussians, gaussians * _BITS_PER_GAUSSIAN // 8 if slots else 0, _OVERHEAD)


class DecodedChannel(CodesChannel):
    """The channel in a model that was decoded from a file of some format; see `Decoded`."""

    def __init__(self, decoded: Decoded) -> None:
        super().__init__(decoded.codes.name)
        self.decoded = decoded
        self.place = f"steps of its numbers, which are those of a {self.format} file"

    def prepare(self, cover: Gaussians) -> CodesCover:
        """`cover`: the model of `decoded`, or the same with fewer harmonics."""
        return CodesCover.of(self.decoded.codes, replace(self.decoded, model=cover.detach().to("cpu")))


@dataclass(frozen=True)
class CodesCover:
    """Codes whose room is known; see `keyss.channels.base.PreparedCover`."""

    codes: Codes  # in the order in which bits are counted
    fields: list[Field]
    free: list[Flags]  # of each field, which levels may be changed
    decoded: Decoded | None = None  # the model that is published in the place of the codes, in that order

    @staticmethod
    def of(codes: Codes, decoded: Decoded | None = None) -> CodesCover:
        """Raises UsageError for codes without room. `decoded`: the model that is published, not the codes."""
        ordered, fields = in_counted_order(codes, decoded.exact if decoded else None)
        model = decoded[counted_order(codes)] if decoded else None
        cover = CodesCover(ordered, fields, changeable(ordered, fields, _digest(codes)), model)
        if not cover.zones.slots or cover.rate < ZONE_RATE:
            raise UsageError(
                f"a cover of {len(fields[0].levels):,} Gaussians has no room for secrets in the codes of "
                f"{codes.name} files"
            )
        return cover

    @property
    def zones(self) -> Zones:
        return _zones(self.fields)

    @cached_property
    def dry(self) -> Bits:
        """[room.bits] 1 where a bit may be changed."""
        parts = [np.repeat(free, each.bits) for free, each in zip(self.free, self.fields, strict=True)]
        return np.concatenate(parts).astype(np.uint8)

    @property
    def rate(self) -> int:
        """Bits that a block holds."""
        return rate_of(float(np.mean(self.dry)))

    @property
    def size(self) -> int:
        """Bytes of all encrypted secrets together, at most."""
        return self.zones.data_blocks * self.rate // 8

    @cached_property
    def room(self) -> Room:
        compressible = int(self.size * (1 - 2**-10))  # incompressible data grow by less than that
        return Room(self._count, compressible, _OVERHEAD)

    @property
    def cover(self) -> Gaussians:
        return self.decoded.model if self.decoded else CodedGaussians.of(self.codes)

    @property
    def _count(self) -> int:
        """Gaussians."""
        return len(self.codes)

    def embed(self, contents: Sequence[tuple[str, Content]], *, entropy: bytes | None = None) -> Gaussians:
        """See `PreparedCover`. Raises UsageError for more secrets than there are slots, too."""
        packed = [pack_payload(content) for _, content in contents]
        mixed = randomness(entropy, _digest(self.codes), *packed)
        for attempt in range(_ATTEMPTS):
            own = expand(mixed, f"codes/attempt/{attempt}", 32)
            salt = expand(own, "codes/salt", SALT_BYTES)
            keys = [DerivedKey.of(key, salt) for key, _ in contents]
            check_keys([key.verifier() for key in keys])
            embedded = self._embedded(list(zip(keys, packed, strict=True)), salt, own)
            if embedded is None:
                continue
            within = random_fractions(own, "codes/file-order", 3 * self._count).reshape(-1, 3) - 0.5
            order = file_order(embedded, within)
            if self.decoded is None:
                return CodedGaussians.of(in_rows(embedded, order))
            if not self.decoded.is_sorted:
                order = self.decoded.order.argsort()
            return self.decoded.with_codes(self.codes, embedded)[torch.from_numpy(order)]
        raise RuntimeError("no block order was found in which all blocks have room")

    def _embedded(
        self, secrets: Sequence[tuple[DerivedKey, bytes]], salt: bytes, entropy: bytes
    ) -> Codes | None:
        """None if a block has too few bits that may change, which happens once in a hundred times."""
        zones, sizes = self.zones, [compressed_size(packed) + OVERHEAD for _, packed in secrets]
        if len(secrets) > zones.slots:
            raise UsageError(f"this cover has room for {zones.slots} secrets, got {len(secrets)}")
        if sum(sizes) > self.size:
            raise UsageError(
                f"the secrets take {sum(sizes):,} bytes, and this cover of {self._count:,} Gaussians has "
                f"room for {self.size:,}"
            )
        zone = bytearray(salt + stream(entropy, "codes/slots", zones.slots * SLOT_BYTES))
        data = _noise(entropy, "codes/noise", zones.data_blocks * self.rate)
        starts = _starts(sizes, len(data), entropy)
        slots = random_order(entropy, "codes/slot-order", zones.slots).tolist()
        for (key, packed), size, start, slot in zip(secrets, sizes, starts, slots, strict=False):
            at = SALT_BYTES + slot * SLOT_BYTES
            zone[at : at + SLOT_BYTES] = Header(self.rate, start, size).encrypt(key, slot)
            encrypted = encrypt(_data_key(key), packed, _ASSOCIATED, size=size)
            data[_range(len(data), start, size)] = to_bits(encrypted)
        bits = self._solved(to_bits(bytes(zone)), data, salt, entropy)
        return None if bits is None else self._written(bits, entropy)

    def _solved(self, zone: Bits, data: Bits, salt: bytes, entropy: bytes) -> Bits | None:
        """The last bits of all levels; those that may change are random."""
        bits = np.where(self.dry, _noise(entropy, "codes/free", self.zones.bits), last_bits(self.fields))
        zone = np.append(zone, _noise(entropy, "codes/zone", -len(zone) % ZONE_RATE))
        matrices = _zone_matrix(), _data_matrix(salt, self.rate)
        for places, message, rows in zip(self.zones.places(salt), (zone, data), matrices, strict=True):
            solved = syndromes.write(bits[places], self.dry[places], message, rows)
            if solved is None:
                return None
            bits[places] = solved
        return bits

    def _written(self, bits: Bits, entropy: bytes) -> Codes:
        columns: dict[str, list[Levels]] = {}
        for field, free in zip(self.fields, self.free, strict=True):
            own, bits = bits[: field.room], bits[field.room :]
            ties = random_fractions(entropy, f"codes/ties/{field.name}/{field.column}", len(free)) - 0.5
            levels = np.where(free, field.with_bits(own, ties), field.levels)
            columns.setdefault(field.name, []).append(levels)
        attributes = {name: np.stack(each, axis=1) for name, each in columns.items()}
        written: Codes = carrying(self.codes).with_levels(self.codes, attributes)
        return written


@dataclass(frozen=True)
class CodesReader(SaltedReader):
    """Codes as a reader sees them."""

    room: Zones
    bits: Bits  # the last ones of all levels
    zone: bytes  # salt and slots
    salts: Sequence[bytes]

    @staticmethod
    def of(codes: Codes, exact: Flags | None = None) -> CodesReader | None:
        """None for codes without room. `exact`: of a model that was decoded from the codes."""
        _, fields = in_counted_order(codes, exact)
        room = _zones(fields)
        if not room.slots:
            return None
        bits = last_bits(fields)
        zone = to_bytes(syndromes.read(bits[room.zone_places()[0]], _zone_matrix()))
        return CodesReader(room, bits, zone[: SALT_BYTES + room.slots * SLOT_BYTES], [zone[:SALT_BYTES]])

    def extract(self, key: DerivedKey) -> Payload:
        """`open` after key derivation. A key that opens nothing makes the same passes."""
        (salt,) = self.salts
        header = find_header(self.zone, key, self.room)
        rate = header.rate if header else _USUAL_RATE
        _, places = self.room.places(salt)
        data = syndromes.read(self.bits[places], _data_matrix(salt, rate))
        start, size = (header.start, header.size) if header else (0, len(data) // 8)
        encrypted = to_bytes(data[_range(len(data), start, size)])
        try:
            return unpack_payload(decrypt(_data_key(key), encrypted, _ASSOCIATED))
        except InputError:
            if header is None:
                raise WrongKeyError() from None
            raise


def _zones(fields: Sequence[Field]) -> Zones:
    return Zones(sum(each.room for each in fields))


def _data_key(key: DerivedKey) -> bytes:
    return key.expand("codes/data", 32)


def last_bits(fields: Sequence[Field]) -> Bits:
    """The last bits of all levels, field after field."""
    return np.concatenate([each.read() for each in fields])


def _zone_matrix() -> Words:
    return syndromes.matrix(bytes(SALT_BYTES), ZONE_RATE)


def _data_matrix(salt: bytes, rate: int) -> Words:
    return syndromes.matrix(salt + bytes(16), rate)


def _range(count: int, start: int, size: int) -> Integers:
    """`size` bytes from bit `start` on, of `count` bits that continue at the start."""
    return (start + np.arange(8 * size)) % count


def _starts(sizes: Sequence[int], room: int, entropy: bytes) -> list[int]:
    """First bits of ranges of `sizes` bytes in a circle of `room` bits; all arrangements are alike."""
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
