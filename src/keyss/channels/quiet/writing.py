"""Fill the carriers of a cover: headers, records, and noise everywhere else.

Gaussians are filled in random order and may be lost: headers have copies, and each record has its own cell.
Blocks of codes are never lost: a secret is a header, followed by the blocks of its payload.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np
from numpy.lib.stride_tricks import as_strided

from keyss.channels.base import NOT_INDEPENDENT, Content, Payload, RecordPlan, RecordRequest, Records
from keyss.channels.mixing import random_order, random_words
from keyss.channels.quiet.cells import CellCipher
from keyss.channels.quiet.layout import (
    BLOCK_HEADER,
    DATA_KEY_BYTES,
    KEY_COPIES,
    LEAST_BYTES,
    PARAMETER_COPIES,
    LowBitsCapacity,
    numbered_chunks,
)
from keyss.channels.quiet.parameters import (
    PAYLOAD,
    RECORDS,
    Parameters,
    key_cipher,
    pack_codewords,
    parameter_cipher,
)
from keyss.channels.sketch import sketch
from keyss.core.arrays import Bytes, Integers
from keyss.core.errors import KeyssWarning, UsageError
from keyss.keys.derivation import DerivedKey, expand, fill
from keyss.keys.encryption import OVERHEAD, compressed_size, encrypt, encrypted_size

ASSOCIATED = b"keyss/v1/quiet"  # authenticated with a payload
_AT_ONCE = 1 << 18  # records that are encrypted at a time
_NO_COPIES: Integers = np.zeros(0, np.int64)


class Writer:
    """The bytes of carriers with `ids` [C, 16], `width` bytes each.

    `entropy`: 32 secret bytes. `gaussians`: IDs [N, 16] of all Gaussians of the model,
    or their number if carriers are blocks.
    """

    def __init__(self, ids: Bytes, width: int, entropy: bytes, gaussians: Bytes | int) -> None:
        self._entropy, self._all_ids = entropy, gaussians
        self._blocks = isinstance(gaussians, int)
        self._gaussians = gaussians if isinstance(gaussians, int) else len(gaussians)
        self._capacity = LowBitsCapacity(len(ids), width)
        self.order = np.arange(len(ids))
        if not self._blocks:
            self.order = random_order(entropy, "quiet/order", len(ids))
        self._ids = ids[self.order]  # [C, 16] in the order of `table`
        self.table = np.empty((len(ids), width), np.uint8)
        fill(entropy, "quiet/noise", self.table)
        self.headers = 0  # number of carriers with headers, which come first

    def write(self, contents: Sequence[tuple[Sequence[DerivedKey], Content]]) -> None:
        """Headers in the first carriers, records in the others. Raises UsageError for too large payloads.

        Each secret comes with its key under every salt that is not stale.
        """
        payloads = [each for _, each in contents if isinstance(each, Payload)]
        records = [each for _, each in contents if isinstance(each, Records)]
        if len(payloads) < len(contents) and (payloads or self._blocks):
            raise TypeError("expected payloads, or records in low bits, and not both in one model")
        if self._blocks:
            self._write_blocks([keys[0] for keys, _ in contents], payloads)
            return
        if payloads:
            sizes = [encrypted_size(compressed_size(each.data)) for each in payloads]
            plans, independent = self._capacity.plan_payloads(sizes)
            for index, (payload, plan, size) in enumerate(zip(payloads, plans, sizes, strict=True)):
                chunks = numbered_chunks(plan.codewords, self._encrypted(index, payload, size), plan.cells)
                cells = RecordPlan(chunks.shape[1], 0, plan.cells_per_carrier)
                header = pack_codewords(size, plan.codewords)
                records.append(Records(payload.method, header, chunks, cells, _NO_COPIES))
        else:
            requests = [
                RecordRequest(len(each.records), each.records.shape[1], len(each.header)) for each in records
            ]
            independent = self._capacity.is_independent_layout([each.plan for each in records], requests)
        service = PAYLOAD if payloads else RECORDS
        for index, ((keys, _), each) in enumerate(zip(contents, records, strict=True)):
            self.headers = self._header(self.headers, index, keys, each, service)
        self._place_all(records, self._capacity.reserved([len(each.header) for each in records], independent))
        if not independent and len(contents) > 1:
            warnings.warn(NOT_INDEPENDENT, KeyssWarning, stacklevel=4)

    def _write_blocks(self, keys: Sequence[DerivedKey], payloads: Sequence[Payload]) -> None:
        """Each secret takes consecutive blocks, cyclically; all arrangements are equally likely."""
        width, count = self._capacity.width, self._capacity.carriers
        takes = [blocks_for(each, width) for each in payloads]
        if (free := count - sum(takes)) < 0:
            raise UsageError(
                f"the secrets take {width * sum(takes):,} bytes, and this cover of {self._gaussians:,} "
                f"Gaussians has room for {width * count:,}"
            )
        first, *gaps = random_words(self._entropy, "quiet/gaps", len(keys) + 1).tolist()
        gaps = sorted(gap % (free + 1) for gap in gaps)
        for index in random_order(self._entropy, "quiet/along", len(keys)).tolist():
            data = self._encrypted(index, payloads[index], width * (takes[index] - BLOCK_HEADER))
            rows = np.frombuffer(data, np.uint8).reshape(-1, width)
            content = Records(payloads[index].method, b"", rows, RecordPlan(width, 0, 1), _NO_COPIES)
            at = self._header((first + gaps.pop(0)) % count, index, [keys[index]], content, PAYLOAD)
            self.table[(at + np.arange(len(rows))) % count] = rows
            first += takes[index]

    def _encrypted(self, index: int, payload: Payload, size: int) -> bytes:
        return encrypt(payload_key(self._data_key(index)), payload.data, ASSOCIATED, size=size)

    def _data_key(self, index: int) -> bytes:
        return expand(self._entropy, f"quiet/data-key/{index}", DATA_KEY_BYTES)

    def _header(self, at: int, index: int, keys: Sequence[DerivedKey], content: Records, service: int) -> int:
        """Write a header into the carriers from `at` on, one cell each; returns the carrier after it."""
        data_key, (count, size) = self._data_key(index), content.records.shape
        key_copies, part_copies = (1, 1) if self._blocks else (KEY_COPIES, PARAMETER_COPIES)
        width = LEAST_BYTES if self._blocks else self._capacity.width
        parameters = Parameters(
            service,
            content.method,
            content.plan.cells_per_carrier,
            size,
            self._gaussians,
            count + len(content.copied),
            content.header,
            b"" if isinstance(self._all_ids, int) else sketch(data_key, self._all_ids),
        )
        copies = np.frombuffer(data_key * key_copies, np.uint8).reshape(key_copies, -1)
        cells = [(key_cipher(key), copies) for key in keys]
        parts = np.tile(parameters.parts(width), (part_copies, 1))
        for cipher, data in (*cells, (parameter_cipher(data_key, width), parts)):
            rows = (at + np.arange(len(data))) % len(self.table)
            self.table[rows, : cipher.cell_bytes] = cipher.encrypt(self._ids[rows], data)
            at += len(data)
        return at

    def _place_all(self, contents: Sequence[Records], headers: int) -> None:
        """Place records in random cells, smaller cells first; the larger ones take untouched carriers."""
        carriers = np.arange(headers, self._capacity.carriers)
        for cells in sorted({each.plan.cells_per_carrier for each in contents}, reverse=True):
            free = random_order(self._entropy, f"quiet/cells/{cells}", cells * len(carriers))
            touched = np.zeros(len(carriers), bool)
            for index, each in enumerate(contents):
                if each.plan.cells_per_carrier == cells:
                    count = len(each.records) + len(each.copied)
                    (rows, slots), free = np.divmod(free[:count], cells), free[count:]
                    self._place(index, each, carriers[rows], slots)
                    touched[rows] = True
            carriers = carriers[~touched]

    def _place(self, index: int, content: Records, rows: Integers, slots: Integers) -> None:
        """Records, then copies, in the cells `slots` [R] of the carriers `rows` [R]."""
        count, width = content.plan.cells_per_carrier, self._capacity.width
        cells = as_strided(self.table, (len(self.table), count, width // count), (width, width // count, 1))
        copies = content.records[content.copied]
        for label, records, at in (("record", content.records, 0), ("copy", copies, len(content.records))):
            cipher = CellCipher(self._data_key(index), label, records.shape[1])
            for start in range(0, len(records), _AT_ONCE):
                part = records[start : start + _AT_ONCE]
                places = slice(at + start, at + start + len(part))
                own, which = rows[places], slots[places]
                cells[own, which, : cipher.cell_bytes] = cipher.encrypt(self._ids[own], part, which)


def blocks_for(payload: Payload, width: int) -> int:
    """The number of blocks of `width` bytes that a payload takes."""
    return BLOCK_HEADER + -(-(compressed_size(payload.data) + OVERHEAD) // width)


def payload_key(data_key: bytes) -> bytes:
    """The key that encrypts a payload, before it is cut into chunks."""
    return expand(data_key, "payload-key", 32)


def bytes_of(content: Content) -> bytes:
    """The bytes of a content."""
    return content.data if isinstance(content, Payload) else content.header + content.records.tobytes()
