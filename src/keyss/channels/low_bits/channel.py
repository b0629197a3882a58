"""Secrets in the low bits of a model, to be found again with nothing but the model and a key.

There is nothing to be recognised: no magic number, no table, no order. What a key decrypts is found by trying
every Gaussian's cell and keeping those whose tag fits.

- The *salt* of Argon2id is a hash of the smallest identity (see `bits`), as good as random and different for
  every model. Because that Gaussian may be removed, there are key cells for each of the SALTS smallest.
- *Key cells*, encrypted under what the key becomes with a salt, hold the secret's data key.
- *Parameter cells*, encrypted under the data key, tell how the rest is read (see `parameters`).
- *Content cells* are encrypted under the data key too: the chunks of an encrypted payload (see `spread`), or
  records. Records need no number: shuffling and cropping are harmless, and who removes a carrier removes its
  record and no more. *Copies* of some records have another label; they count where the record is gone.

Which carrier gets what is drawn at random, and every usable carrier gets new low bits, noise if nothing else:
cells of other secrets and of none look alike. All randomness comes from `entropy`, which nobody else may
know: if it followed from the cover and one secret, the holder of that secret's key could compute what the
file would be without the others. No key stream is used twice: data keys depend on entropy and on all
contents, and the key stream of a cell on the data in it (see `cells`).
"""

from __future__ import annotations

import hashlib
import os
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from keyss.channels.base import Bytes, Content, Payload, RecordPlan, RecordRequest, Records
from keyss.channels.low_bits import parameters, spread
from keyss.channels.low_bits.bits import (
    Flags,
    bytes_per_gaussian,
    check_usable,
    identities,
    read_low_bits,
    usable_carriers,
    write_low_bits,
)
from keyss.channels.low_bits.cells import TAG_BYTES, CellCipher
from keyss.channels.low_bits.layout import (
    DATA_KEY_BYTES,
    KEY_COPIES,
    SALTS,
    part_bytes,
    plan_records,
    record_bytes,
    record_capacity,
    shares,
)
from keyss.channels.low_bits.parameters import PayloadParameters, RecordParameters
from keyss.core.errors import InputError, UsageError, WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.keys.derivation import SALT_BYTES, DerivedKey, KeyDerivation, expand, stream
from keyss.keys.encryption import compressed_size, decrypt, encrypt, encrypted_size

SALTS_TRIED = 4  # of a model half of whose Gaussians were changed, 15 of 16 then open
_ASSOCIATED, _PAYLOAD_KEY = b"keyss/v1/low-bits", "payload-key"
_OPENS_NOTHING = "this key opens nothing here"


class LowBits:
    """The channel; see `keyss.channels.base.Channel`."""

    def largest_record(self, sh_degree: int) -> int:
        return record_bytes(sh_degree, 1)

    def prepare(self, cover: Gaussians) -> LowBitsCover:
        usable = usable_carriers(cover)
        check_usable(cover, usable)
        return LowBitsCover(cover, usable)

    def extract(self, stego: Gaussians, key: str) -> Content:
        """See `Channel`. If the first salt opens nothing others are tried, SALTS_TRIED in all.

        Changed or added Gaussians may have taken the first ones' places, and should not lock out the key.
        """
        reader = LowBitsReader.of(stego)
        for derived in reader.keys(key):
            with suppress(WrongKeyError):
                return reader.extract(derived)
        raise WrongKeyError(_OPENS_NOTHING)


LOW_BITS = LowBits()


@dataclass(frozen=True)
class LowBitsCover:
    """A cover and which of its Gaussians are carriers; see `keyss.channels.base.PreparedCover`."""

    cover: Gaussians
    usable: Flags  # [N]

    @property
    def carriers(self) -> int:
        return int(self.usable.sum())

    def record_capacity(self, requests: Sequence[RecordRequest]) -> int:
        return record_capacity(requests, self.carriers, self.cover.sh_degree)

    def plan_records(self, requests: Sequence[RecordRequest]) -> list[RecordPlan]:
        return plan_records(requests, self.carriers, self.cover.sh_degree)

    def embed(self, contents: Sequence[tuple[str, Content]], *, entropy: bytes | None = None) -> Gaussians:
        """See `PreparedCover`. Takes 1.6 s for each secret for key derivation."""
        derivations = [derivation_of(identity) for identity in salts(identities(self.cover))]
        derived = [([DerivedKey(key, each) for each in derivations], content) for key, content in contents]
        return self.embed_derived(derived, entropy=entropy)

    def embed_derived(
        self, contents: Sequence[tuple[Sequence[DerivedKey], Content]], *, entropy: bytes | None = None
    ) -> Gaussians:
        """`embed` after key derivation: for each secret its key under each of the salts."""
        if len({keys[0].verifier() for keys, _ in contents}) != len(contents) or not contents:
            raise UsageError("two secrets have the same key: expected at least one secret, each with its own")
        secret_entropy = hashlib.sha256(os.urandom(32) if entropy is None else entropy)
        for _, content in contents:
            secret_entropy.update(_digest(content))
        writer = _Writer(self, secret_entropy.digest())
        payloads = [(keys, each) for keys, each in contents if isinstance(each, Payload)]
        records = [(keys, each) for keys, each in contents if isinstance(each, Records)]
        if payloads and records:
            raise ValueError("expected payloads or records in one model, got both")
        writer.payloads(payloads)
        writer.records(records)
        return write_low_bits(self.cover, writer.rows, writer.table)


@dataclass(frozen=True)
class LowBitsReader:
    """A stego model as a reader sees it."""

    identities: Bytes  # [N, 16]
    low: Bytes  # [N, B] low bits
    sh_degree: int

    @staticmethod
    def of(stego: Gaussians) -> LowBitsReader:
        return LowBitsReader(identities(stego), read_low_bits(stego), stego.sh_degree)

    def keys(self, key: str, most: int = SALTS_TRIED) -> Iterator[DerivedKey]:
        """What `key` becomes under each salt to be tried, the likeliest first; each takes 0.1 s."""
        return (DerivedKey(key, derivation_of(identity)) for identity in salts(self.identities)[:most])

    def extract(self, key: DerivedKey) -> Content:
        """The content under this key and its salt. Raises WrongKeyError and InputError.

        A key that opens nothing makes the same passes over all cells, under a data key that fits nothing.
        """
        if part_bytes(self.sh_degree) == 0:
            raise WrongKeyError(_OPENS_NOTHING)
        found = self._decrypt(_key_cipher(key))
        votes = Counter(row.tobytes() for row in found).most_common(1)
        data_key = votes[0][0] if votes else key.expand("low-bits/none", DATA_KEY_BYTES)
        parts = self._decrypt(_parameter_cipher(data_key, self.sh_degree))
        if not len(parts):  # by chance the tag of a key cell fits once in 2^32
            self._decrypt(_chunk_cipher(data_key, self.sh_degree))
            raise WrongKeyError(_OPENS_NOTHING)
        found_parameters = parameters.unpack(parts, spread.chunk_bytes(self.sh_degree))
        if isinstance(found_parameters, PayloadParameters):
            return self._payload(found_parameters, data_key)
        return self._records(found_parameters, data_key)

    def _payload(self, found: PayloadParameters, data_key: bytes) -> Payload:
        chunks = self._decrypt(_chunk_cipher(data_key, self.sh_degree))
        encrypted = found.spread.decode(chunks, found.size)
        data = decrypt(expand(data_key, _PAYLOAD_KEY, 32), encrypted, _ASSOCIATED)
        return Payload(found.method, data, found.spread.left(chunks))

    def _records(self, found: RecordParameters, data_key: bytes) -> Records:
        room = self.low.shape[1] // found.cells - TAG_BYTES
        if not 0 < found.record_bytes <= room:
            raise InputError("the hidden parameters are damaged: records larger than their cells")
        records, copies = (
            self._decrypt(CellCipher(data_key, label, found.record_bytes), found.cells)
            for label in ("record", "copy")
        )
        records = np.concatenate([records, copies[~_are_among(copies, records)]])
        if not len(records):
            raise InputError("the key is right, but nothing is left of what it opens")
        plan = RecordPlan(room, 0, found.cells)
        return Records(found.method, found.header, records, plan, np.zeros(0, np.int64))

    def _decrypt(self, cipher: CellCipher, cells: int = 1) -> Bytes:
        """[M, size] what the cipher decrypts in any of the `cells` of each carrier, in order of carriers."""
        size = self.low.shape[1] // cells
        found = [
            cipher.decrypt(self.identities, self.low[:, slot * size : (slot + 1) * size], slot)
            for slot in range(cells)
        ]
        origin = np.concatenate([np.flatnonzero(fits) for fits, _ in found])
        return np.concatenate([data for _, data in found])[np.argsort(origin, kind="stable")]


def salts(names: Bytes) -> list[bytes]:
    """Of identities [N, 16] those that may serve as salt, in ascending order."""
    prefixes = names[:, :8].copy().view(">u8")[:, 0].astype(np.uint64)  # `isin` takes native numbers only
    first = names[np.isin(prefixes, np.unique(prefixes)[:SALTS])]
    return sorted({row.tobytes() for row in first})[:SALTS]


def derivation_of(identity: bytes) -> KeyDerivation:
    """The costs are fixed: there is nowhere to state others before a key is derived."""
    return KeyDerivation(salt=hashlib.sha256(b"keyss/v1/salt" + identity).digest()[:SALT_BYTES])


class _Writer:
    """Fills the carriers, which come in random order: first the headers, then contents; the rest is noise."""

    def __init__(self, prepared: LowBitsCover, entropy: bytes) -> None:
        self._cover, self._entropy = prepared.cover, entropy
        self._degree = prepared.cover.sh_degree
        rows = np.flatnonzero(prepared.usable)
        order = np.frombuffer(stream(entropy, "low-bits/order", 8 * len(rows)), "<u8")
        self.rows = rows[np.argsort(order, kind="stable")]
        self._names = identities(prepared.cover)[self.rows]
        width = bytes_per_gaussian(self._degree)
        noise = stream(entropy, "low-bits/noise", len(rows) * width)
        self.table = np.frombuffer(bytearray(noise), np.uint8).reshape(len(rows), width)
        self._next = 0  # carrier that is not in use yet

    def payloads(self, contents: Sequence[tuple[Sequence[DerivedKey], Payload]]) -> None:
        """Every secret fills a share of the carriers that depends on the number of shares only."""
        share = len(self.rows) // shares(len(contents))
        for index, (keys, content) in enumerate(contents):
            # Spread as its own size asks: what a key shows must not depend on the sizes of other secrets.
            size = encrypted_size(compressed_size(content.data))
            plan = spread.plan_spread(len(self.rows), len(contents), self._degree, size)
            if plan is None:
                usable = len(self.rows) / len(self._cover)
                raise UsageError(
                    spread.too_small(len(self._cover), usable, size, len(contents), self._degree)
                )
            self._next = index * share
            data_key = self._data_key(index)
            self._header(keys, data_key, PayloadParameters(content.method, size, plan).pack())
            payload_key = expand(data_key, _PAYLOAD_KEY, 32)
            encrypted = encrypt(payload_key, content.data, _ASSOCIATED, size=size)
            cells = (index + 1) * share - self._next
            self._whole(_chunk_cipher(data_key, self._degree), plan.encode(encrypted, cells))

    def records(self, contents: Sequence[tuple[Sequence[DerivedKey], Records]]) -> None:
        """Headers and records with whole carriers first, then records that divide what is left."""
        for index, (keys, content) in enumerate(contents):
            cells, size = content.plan.cells_per_carrier, content.records.shape[1]
            packed = RecordParameters(content.method, cells, size, content.header).pack()
            self._header(keys, self._data_key(index), packed)
        turns = np.frombuffer(stream(self._entropy, "low-bits/turns", len(self.rows)), np.uint8)
        shared = 0  # cells in use of the carriers that are divided
        for index in sorted(range(len(contents)), key=lambda i: contents[i][1].plan.cells_per_carrier):
            content = contents[index][1]
            cells = content.plan.cells_per_carrier
            for label, records in (("record", content.records), ("copy", content.records[content.copied])):
                cipher = CellCipher(self._data_key(index), label, records.shape[1])
                if cells == 1:
                    self._whole(cipher, records)
                    continue
                # All that divide carriers have equally many cells: carrier by carrier, then again from the
                # first one, each time with the next of its cells, from a random one on.
                carriers = len(self.rows) - self._next
                number = shared + np.arange(len(records))
                shared += len(records)
                row = self._next + number % carriers
                slot = (number // carriers + turns[row]) % cells
                column = (slot * (self.table.shape[1] // cells))[:, None] + np.arange(cipher.cell_bytes)
                self.table[row[:, None], column] = cipher.encrypt(self._names[row], records, slot)

    def _data_key(self, index: int) -> bytes:
        return expand(self._entropy, f"low-bits/data-key/{index}", DATA_KEY_BYTES)

    def _header(self, keys: Sequence[DerivedKey], data_key: bytes, packed: bytes) -> None:
        for key in keys:
            copies = np.frombuffer(data_key * KEY_COPIES, np.uint8).reshape(KEY_COPIES, -1)
            self._whole(_key_cipher(key), copies)
        parts = parameters.parts_of(packed, self._degree)
        self._whole(_parameter_cipher(data_key, self._degree), parts)

    def _whole(self, cipher: CellCipher, data: Bytes) -> None:
        """A carrier for each row of `data`; what a cell does not need of it stays noise."""
        rows = slice(self._next, self._next + len(data))
        self.table[rows, : cipher.cell_bytes] = cipher.encrypt(self._names[rows], data)
        self._next += len(data)


def _key_cipher(key: DerivedKey) -> CellCipher:
    return CellCipher(key.expand("low-bits/key", 32), "key", DATA_KEY_BYTES)


def _parameter_cipher(data_key: bytes, sh_degree: int) -> CellCipher:
    return CellCipher(data_key, "parameters", 1 + part_bytes(sh_degree))


def _chunk_cipher(data_key: bytes, sh_degree: int) -> CellCipher:
    size = spread.NUMBER_BYTES + spread.chunk_bytes(sh_degree)
    return CellCipher(data_key, "chunk", size, spread.TAG_BYTES)


def _digest(content: Content) -> bytes:
    data = content.data if isinstance(content, Payload) else content.header + content.records.tobytes()
    return hashlib.sha256(data).digest()


def _are_among(rows: Bytes, others: Bytes) -> Flags:
    """[R] which of the rows are there among the others."""
    code = f"S{rows.shape[1]}"  # bytes of a fixed length: zeros at their end make no difference
    return np.isin(rows.view(code)[:, 0], others.view(code)[:, 0])
