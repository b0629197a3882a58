"""Filling the carriers of a cover, in random order: headers, records, and noise in all the rest."""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Sequence

import numpy as np
from numpy.lib.stride_tricks import as_strided

from keyss.channels.base import Content, Payload, RecordPlan, RecordRequest, Records
from keyss.channels.low_bits.cells import CellCipher
from keyss.channels.low_bits.layout import DATA_KEY_BYTES, KEY_COPIES, LowBitsRoom, PayloadPlan
from keyss.channels.low_bits.parameters import (
    PAYLOAD,
    RECORDS,
    Parameters,
    key_cipher,
    pack_codewords,
    parameter_cipher,
)
from keyss.channels.low_bits.spread import numbered_chunks
from keyss.channels.mixing import random_order
from keyss.channels.payloads import NOTICED
from keyss.core.arrays import Bytes, Integers
from keyss.core.errors import KeyssWarning
from keyss.keys.derivation import DerivedKey, expand, fill
from keyss.keys.encryption import compressed_size, encrypt, encrypted_size
from keyss.rendering.cpu.parallel import in_blocks

ASSOCIATED = b"keyss/v1/low-bits"  # authenticated with a payload
_BLOCK = 1 << 13  # records at a time


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
        self._next = 0  # carrier that is not in use yet

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
        rows = slice(self._next, self._next + len(data))
        self.table[rows, : cipher.cell_bytes] = cipher.encrypt(self._names[rows], data)
        self._next += len(data)

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
