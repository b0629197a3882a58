"""Filling the carriers of a cover: headers, records, and noise in all the rest.

Gaussians are taken in random order, and may be lost: headers have copies, and records lie in cells of their
own. Blocks of codes are all there: a secret is a header and the payload in the blocks after it, as they are.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np
from numpy.lib.stride_tricks import as_strided

from keyss.channels.base import NOTICED, Content, Payload, RecordPlan, RecordRequest, Records
from keyss.channels.mixing import random_order, random_words
from keyss.channels.quiet.cells import CellCipher
from keyss.channels.quiet.layout import (
    BLOCK_HEADER,
    DATA_KEY_BYTES,
    KEY_COPIES,
    LEAST_BYTES,
    PARAMETER_COPIES,
    LowBitsRoom,
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
    """The bytes of carriers with identities `names` [C, 16], `width` of each.

    `entropy`: 32 bytes that nobody else knows. `gaussians`: identities [N, 16] of all Gaussians of the model,
    or their number if carriers are blocks.
    """

    def __init__(self, names: Bytes, width: int, entropy: bytes, gaussians: Bytes | int) -> None:
        self._entropy, self._every = entropy, gaussians
        self._blocks = isinstance(gaussians, int)
        self._gaussians = gaussians if isinstance(gaussians, int) else len(gaussians)
        self._room = LowBitsRoom(len(names), width)
        self.order = np.arange(len(names))
        if not self._blocks:
            self.order = random_order(entropy, "quiet/order", len(names))
        self._names = names[self.order]  # [C, 16] as in all below
        self.table = np.empty((len(names), width), np.uint8)
        fill(entropy, "quiet/noise", self.table)
        self.headers = 0  # carriers of headers, which are the first

    def write(self, contents: Sequence[tuple[Sequence[DerivedKey], Content]]) -> None:
        """Headers in the first carriers, records in the others. Raises UsageError for too large payloads.

        Keys: of each secret one under each salt that is not stale.
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
            plans, as_alone = self._room.plan_payloads(sizes)
            for index, (payload, plan, size) in enumerate(zip(payloads, plans, sizes, strict=True)):
                chunks = numbered_chunks(plan.codewords, self._encrypted(index, payload, size), plan.cells)
                cells = RecordPlan(chunks.shape[1], 0, plan.cells_per_carrier)
                header = pack_codewords(size, plan.codewords)
                records.append(Records(payload.method, header, chunks, cells, _NO_COPIES))
        else:
            requests = [
                RecordRequest(len(each.records), each.records.shape[1], len(each.header)) for each in records
            ]
            as_alone = self._room.is_independent_layout([each.plan for each in records], requests)
        service = PAYLOAD if payloads else RECORDS
        for index, ((keys, _), each) in enumerate(zip(contents, records, strict=True)):
            self.headers = self._header(self.headers, index, keys, each, service)
        self._place_all(records, self._room.set_aside([len(each.header) for each in records], as_alone))
        if not as_alone and len(contents) > 1:
            warnings.warn(NOTICED, KeyssWarning, stacklevel=4)

    def _write_blocks(self, keys: Sequence[DerivedKey], payloads: Sequence[Payload]) -> None:
        """Each secret in blocks that follow each other, in a circle; all arrangements are equally likely."""
        width, count = self._room.width, self._room.carriers
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
        """Cells in the carriers from `at` on, one in each, the rest of which stays noise; where they end."""
        data_key, (count, size) = self._data_key(index), content.records.shape
        key_copies, part_copies = (1, 1) if self._blocks else (KEY_COPIES, PARAMETER_COPIES)
        width = LEAST_BYTES if self._blocks else self._room.width
        parameters = Parameters(
            service,
            content.method,
            content.plan.cells_per_carrier,
            size,
            self._gaussians,
            count + len(content.copied),
            content.header,
            b"" if isinstance(self._every, int) else sketch(data_key, self._every),
        )
        copies = np.frombuffer(data_key * key_copies, np.uint8).reshape(key_copies, -1)
        cells = [(key_cipher(key), copies) for key in keys]
        parts = np.tile(parameters.parts(width), (part_copies, 1))
        for cipher, data in (*cells, (parameter_cipher(data_key, width), parts)):
            rows = (at + np.arange(len(data))) % len(self.table)
            self.table[rows, : cipher.cell_bytes] = cipher.encrypt(self._names[rows], data)
            at += len(data)
        return at

    def _place_all(self, contents: Sequence[Records], headers: int) -> None:
        """Each secret's records in random cells; large ones in carriers that smaller ones leave."""
        carriers = np.arange(headers, self._room.carriers)
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
        count, width = content.plan.cells_per_carrier, self._room.width
        cells = as_strided(self.table, (len(self.table), count, width // count), (width, width // count, 1))
        copies = content.records[content.copied]
        for label, records, at in (("record", content.records, 0), ("copy", copies, len(content.records))):
            cipher = CellCipher(self._data_key(index), label, records.shape[1])
            for start in range(0, len(records), _AT_ONCE):
                part = records[start : start + _AT_ONCE]
                places = slice(at + start, at + start + len(part))
                own, which = rows[places], slots[places]
                cells[own, which, : cipher.cell_bytes] = cipher.encrypt(self._names[own], part, which)


def blocks_for(payload: Payload, width: int) -> int:
    """The number of blocks of `width` bytes that a payload takes."""
    return BLOCK_HEADER + -(-(compressed_size(payload.data) + OVERHEAD) // width)


def payload_key(data_key: bytes) -> bytes:
    """The key that encrypts a payload, before it is cut into chunks."""
    return expand(data_key, "payload-key", 32)


def bytes_of(content: Content) -> bytes:
    """All that a content hides."""
    return content.data if isinstance(content, Payload) else content.header + content.records.tobytes()
