"""Filling the carriers of a cover, in random order, and reading them with a key.

Carriers hold headers, records, and noise in all the rest.
"""

from __future__ import annotations

import hashlib
import warnings
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.lib.stride_tricks import as_strided

from keyss.channels.base import (
    NOTICED,
    SALTS_TRIED,
    Content,
    Payload,
    RecordPlan,
    RecordRequest,
    Records,
    SaltedReader,
)
from keyss.channels.low_bits import parameters
from keyss.channels.low_bits.bits import Layout, identities, read_low_bits
from keyss.channels.low_bits.cells import CellCipher
from keyss.channels.low_bits.layout import (
    DATA_KEY_BYTES,
    KEY_COPIES,
    LowBitsRoom,
    PayloadPlan,
    numbered_chunks,
    split_numbers,
)
from keyss.channels.low_bits.parameters import (
    PAYLOAD,
    RECORDS,
    Parameters,
    key_cipher,
    pack_codewords,
    parameter_cipher,
)
from keyss.channels.low_bits.salts import salt, salt_rows
from keyss.channels.low_bits.usable import among, repeated
from keyss.channels.mixing import random_order, row_hashes
from keyss.core.arrays import Bytes, Flags, Integers
from keyss.core.errors import InputError, KeyssWarning, WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.keys.derivation import DerivedKey, expand, fill
from keyss.keys.encryption import compressed_size, decrypt, encrypt, encrypted_size
from keyss.rendering.cpu.parallel import in_blocks

ASSOCIATED = b"keyss/v1/low-bits"  # authenticated with a payload
_BLOCK = 1 << 13  # records at a time
_TWO_SECRETS = (
    "this key opens two secrets, because the model was merged from two files: this is the first; reveal the "
    "second from its own file"
)


class Writer:
    """The low bits of carriers with identities `names` [C, 16], each of `width` bytes.

    `entropy`: 32 bytes that nobody else knows. `salts`: the first byte of each salt.
    """

    def __init__(self, names: Bytes, width: int, entropy: bytes, salts: bytes = b"") -> None:
        self._entropy, self._salts = entropy, salts
        self._room = LowBitsRoom(len(names), width)
        self.order = random_order(entropy, "low-bits/order", len(names))  # [C] carriers, as in all below
        self._names = names[self.order]
        self.table = np.empty((len(names), width), np.uint8)
        fill(entropy, "low-bits/noise", self.table)
        self.headers = 0  # carriers of headers, which are the first
        self.places: dict[int, tuple[Integers, Integers]] = {}  # of each content: its carriers and cells

    def write(self, contents: Sequence[tuple[Sequence[DerivedKey], Content]]) -> None:
        """Headers in the first carriers, records in the others. Raises UsageError for too large payloads.

        Keys: of each secret one under each salt that is not stale.
        """
        payloads = [each for _, each in contents if isinstance(each, Payload)]
        records = [each for _, each in contents if isinstance(each, Records)]
        if payloads and records:
            raise ValueError("expected payloads or records in one model, got both")
        if payloads:
            sizes = [encrypted_size(compressed_size(each.data)) for each in payloads]
            plans, as_alone = self._room.plan_payloads(sizes)
            records = [
                self._chunked(index, *each)
                for index, each in enumerate(zip(payloads, plans, sizes, strict=True))
            ]
        else:
            requests = [
                RecordRequest(len(each.records), each.records.shape[1], len(each.header)) for each in records
            ]
            as_alone = self._room.lie_as_alone([each.plan for each in records], requests)
        service = PAYLOAD if payloads else RECORDS
        for index, ((keys, _), each) in enumerate(zip(contents, records, strict=True)):
            self._header(index, keys, each, service)
        self._place_all(records, self._room.set_aside([len(each.header) for each in records], as_alone))
        if not as_alone and len(contents) > 1:
            warnings.warn(NOTICED, KeyssWarning, stacklevel=4)

    def _chunked(self, index: int, payload: Payload, plan: PayloadPlan, size: int) -> Records:
        """A payload as the records of its encrypted chunks."""
        encrypted = encrypt(payload_key(self._data_key(index)), payload.data, ASSOCIATED, size=size)
        chunks = numbered_chunks(plan.codewords, encrypted, plan.cells)
        cells = RecordPlan(chunks.shape[1], 0, plan.cells_per_carrier)
        header = pack_codewords(size, plan.codewords)
        return Records(payload.method, header, chunks, cells, np.zeros(0, np.int64))

    def _data_key(self, index: int) -> bytes:
        return expand(self._entropy, f"low-bits/data-key/{index}", DATA_KEY_BYTES)

    def _header(self, index: int, keys: Sequence[DerivedKey], content: Records, service: int) -> None:
        data_key, width = self._data_key(index), self._room.width
        for key in keys:
            copies = np.frombuffer(data_key * KEY_COPIES, np.uint8).reshape(KEY_COPIES, -1)
            self._whole(key_cipher(key), copies)
        cells, size = content.plan.cells_per_carrier, content.records.shape[1]
        parameters = Parameters(service, content.method, self._salts, cells, size, content.header)
        self._whole(parameter_cipher(data_key, width), parameters.parts(width))

    def _whole(self, cipher: CellCipher, data: Bytes) -> None:
        """A carrier for each row of `data`; what a cell does not need of it stays noise."""
        rows = slice(self.headers, self.headers + len(data))
        self.table[rows, : cipher.cell_bytes] = cipher.encrypt(self._names[rows], data)
        self.headers += len(data)

    def _place_all(self, contents: Sequence[Records], headers: int) -> None:
        """Records that divide carriers in random cells of all carriers, as each secret's would alone.

        The others in carriers that these leave untouched, which are random too.
        """
        carriers = np.arange(headers, self._room.carriers)
        counts = [len(each.records) + len(each.copied) for each in contents]
        divided = [i for i, each in enumerate(contents) if each.plan.cells_per_carrier > 1]
        if divided:
            cells = contents[divided[0]].plan.cells_per_carrier
            free = random_order(self._entropy, "low-bits/cells", cells * len(carriers))
            touched = np.zeros(len(carriers), bool)
            for index in divided:
                own, free = free[: counts[index]], free[counts[index] :]
                order, slots = np.divmod(own, cells)
                self._place(index, contents[index], carriers[order], slots)
                touched[order] = True
            carriers = carriers[~touched]
        for index in (i for i in range(len(contents)) if i not in divided):
            own, carriers = carriers[: counts[index]], carriers[counts[index] :]
            self._place(index, contents[index], own, np.zeros(len(own), np.int64))

    def _place(self, index: int, content: Records, rows: Integers, slots: Integers) -> None:
        """Records, then copies, in the cells `slots` [R] of the carriers `rows` [R]."""
        count, width = content.plan.cells_per_carrier, self._room.width
        cells = as_strided(self.table, (len(self.table), count, width // count), (width, width // count, 1))
        split = len(content.records)
        self.places[index] = rows[:split], slots[:split]
        self._place_some(index, "record", content.records, cells, rows[:split], slots[:split])
        copies = content.records[content.copied]
        self._place_some(index, "copy", copies, cells, rows[split:], slots[split:])

    def _place_some(
        self, index: int, label: str, records: Bytes, cells: Bytes, rows: Integers, slots: Integers
    ) -> None:
        """`records` [R, size] in `cells` [carriers, slots, bytes]."""
        cipher = CellCipher(self._data_key(index), label, records.shape[1])

        def place(start: int, stop: int) -> None:
            own, which = rows[start:stop], slots[start:stop]
            encrypted = cipher.encrypt(self._names[own], records[start:stop], which)
            cells[own, which, : cipher.cell_bytes] = encrypted

        in_blocks(place, len(records), _BLOCK)


def payload_key(data_key: bytes) -> bytes:
    """The key that encrypts a payload, before it is cut into chunks."""
    return expand(data_key, "payload-key", 32)


def digest(content: Content) -> bytes:
    """32 bytes that identify a content."""
    if isinstance(content, Payload):
        return hashlib.sha256(content.data).digest()
    state = hashlib.sha256(content.header)
    state.update(np.ascontiguousarray(content.records).data)
    return state.digest()


@dataclass(frozen=True)
class LowBitsReader(SaltedReader):
    """A stego model as a reader sees it; a Gaussian that occurs twice with equal low bits counts once."""

    identities: Bytes  # [N, 16]
    low: Bytes  # [N, B] low bits
    salts: Sequence[bytes]
    narrow: int  # bytes of `low` before the harmonics above degree 1, which some secrets leave as they are

    @staticmethod
    def of(stego: Gaussians) -> LowBitsReader:
        layout = Layout.of(stego)
        names, low = identities(stego, layout), read_low_bits(stego, layout)
        rows = _first_of_each(names, low)
        if len(rows) < len(names):
            stego, names, low = stego[torch.from_numpy(rows)], names[rows], low[rows]
        salts = [salt(names[row], low[row]) for row in salt_rows(stego, names, low, layout)]
        narrow = replace(layout, written_degree=min(1, layout.sh_degree)).width
        return LowBitsReader(names, low, salts, narrow)

    def open(self, key: str) -> Content:
        """See `Reader`. Warns (KeyssWarning) if the key opens two secrets, as where two files were merged."""
        for derived in self.keys(key):
            with suppress(WrongKeyError):
                data_key, found, width = self._parameters(derived)
                content = self._content(data_key, found, width)
                self._warn_of_another(key, data_key, found.salts)
                return content
        raise WrongKeyError()

    def extract(self, key: DerivedKey) -> Content:
        """`open` after key derivation under one salt.

        A key that opens nothing makes the same passes over all cells, under a data key that fits nothing.
        """
        return self._content(*self._parameters(key))

    def _parameters(self, key: DerivedKey) -> tuple[bytes, Parameters, int]:
        """The data key, the parameters, and the bytes of a carrier."""
        whole = self.low.shape[1]
        if LowBitsRoom(0, whole).part_bytes == 0:
            raise WrongKeyError()
        votes = Counter(row.tobytes() for row in self._decrypt(key_cipher(key), whole)[0]).most_common(1)
        data_key = votes[0][0] if votes else key.expand("low-bits/none", DATA_KEY_BYTES)
        widths = [each for each in dict.fromkeys((whole, self.narrow)) if LowBitsRoom(0, each).part_bytes]
        found = [self._decrypt(parameter_cipher(data_key, width), width)[0] for width in widths]
        for width, parts in zip(widths, found, strict=True):
            if len(parts):
                return data_key, parameters.unpack(parts), width
        # By chance the tag of a key cell fits once in 2^32.
        self._decrypt(CellCipher(data_key, "record", LowBitsRoom(0, whole).record_bytes(1)), whole)
        raise WrongKeyError()

    def _content(self, data_key: bytes, found: Parameters, width: int) -> Content:
        room = LowBitsRoom(0, width).record_bytes(found.cells)
        if not 0 < found.record_bytes <= room:
            raise InputError("the hidden parameters are damaged: records larger than their cells")
        cipher = CellCipher(data_key, "record", found.record_bytes)
        records, full = self._decrypt(cipher, width, found.cells)
        if found.service == parameters.PAYLOAD:
            size, codewords = parameters.unpack_codewords(found.header, found.record_bytes)
            numbers, chunks = split_numbers(records)
            encrypted = codewords.decode(numbers, chunks)[:size]
            left = len(np.unique(numbers[numbers < codewords.chunks]))
            data = decrypt(payload_key(data_key), encrypted, ASSOCIATED)
            return Payload(found.method, data, (left, codewords.chunks))
        cipher = CellCipher(data_key, "copy", found.record_bytes)
        copies, _ = self._decrypt(cipher, width, found.cells, full)
        records = np.concatenate([records, copies[~_are_among(copies, records)]])
        if not len(records):
            raise InputError("the key is right, but nothing is left of what it opens")
        plan = RecordPlan(room, 0, found.cells)
        return Records(found.method, found.header, records, plan, np.zeros(0, np.int64))

    def _warn_of_another(self, key: str, data_key: bytes, own: bytes) -> None:
        """Try a few salts whose first bytes are none of this secret's `own`."""
        foreign = [each for each in self.salts if each[0] not in own]
        for each in foreign[:SALTS_TRIED]:
            with suppress(WrongKeyError, InputError):
                if self._parameters(DerivedKey.of(key, each))[0] != data_key:
                    warnings.warn(_TWO_SECRETS, KeyssWarning, stacklevel=3)
                    return

    def _decrypt(
        self, cipher: CellCipher, width: int, cells: int = 1, full: Flags | None = None
    ) -> tuple[Bytes, Flags]:
        """[M, size] the data that fit in any of the `cells` of each carrier, in the order of carriers.

        Then [cells, N] which cells these are. `width`: bytes of a carrier. `full`: of such a call, cells that
        need not be tried again.
        """
        size, found = width // cells, []
        fitting = np.zeros((cells, len(self.low)), bool)
        for slot, fits in enumerate(fitting):
            rows: slice | Integers = slice(None) if full is None else np.flatnonzero(~full[slot])
            own = self.low[rows, slot * size : (slot + 1) * size]
            fits[rows], data = cipher.decrypt(self.identities[rows], own, slot)
            found.append(data)
        order = np.concatenate([*map(np.flatnonzero, fitting)]).argsort(kind="stable")
        return np.concatenate(found)[order], fitting


def _first_of_each(names: Bytes, low: Bytes) -> Integers:
    """[M] rows of identities `names` [N, 16] and `low` bits [N, B], equal ones only once."""
    doubtful = np.flatnonzero(repeated(names.view("<u8")[:, 0]))
    if not len(doubtful):
        return np.arange(len(names))
    whole = np.concatenate([names[doubtful], low[doubtful]], axis=1)
    _, first = np.unique(whole.view(f"S{whole.shape[1]}")[:, 0], return_index=True)
    return np.setdiff1d(np.arange(len(names)), np.delete(doubtful, first))


def _are_among(rows: Bytes, others: Bytes) -> Flags:
    """[R] which of the rows [R, C] are there among the others [O, C], by their hashes."""
    wanted, known = map(row_hashes, (rows, others))
    return among(wanted, np.sort(known))
