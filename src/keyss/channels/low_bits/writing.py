"""Filling the carriers of a cover, in random order: headers, contents, and noise in all the rest."""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Sequence
from functools import partial

import numpy as np
import numpy.typing as npt
from numpy.lib.stride_tricks import as_strided

from keyss.channels.base import Bytes, Content, Payload, RecordRequest, Records
from keyss.channels.low_bits import parameters, spread
from keyss.channels.low_bits.cells import CellCipher
from keyss.channels.low_bits.ciphers import (
    ASSOCIATED,
    chunk_cipher,
    key_cipher,
    parameter_cipher,
    payload_key,
)
from keyss.channels.low_bits.layout import DATA_KEY_BYTES, KEY_COPIES, Carriers, payload_parts
from keyss.channels.low_bits.parameters import PayloadParameters, RecordParameters
from keyss.channels.mixing import random_order
from keyss.channels.writing import NOTICED
from keyss.core.errors import KeyssWarning, UsageError
from keyss.keys.derivation import DerivedKey, expand, fill
from keyss.keys.encryption import compressed_size, encrypt, encrypted_size
from keyss.rendering.cpu.parallel import in_blocks

_BLOCK = 1 << 13  # records at a time


class Writer:
    """The low bits of carriers with identities `names` [C, 16], each of `width` bytes.

    `entropy`: 32 bytes that nobody else knows.
    """

    def __init__(self, names: Bytes, width: int, entropy: bytes) -> None:
        self._entropy = entropy
        self._room = Carriers(len(names), width)
        self.order = random_order(
            entropy, "low-bits/order", len(names)
        )  # [C] carriers; what follows is in this order
        self._names = names[self.order]
        self.table = np.empty((len(names), width), np.uint8)
        fill(entropy, "low-bits/noise", self.table)
        self._next = 0  # carrier that is not in use yet

    def payloads(self, contents: Sequence[tuple[Sequence[DerivedKey], Payload]], gaussians: int) -> None:
        """Every secret fills its share of the carriers. `gaussians`: of the model, for what is said of it."""
        carriers, width = self._room.carriers, self._room.width
        sizes = [encrypted_size(compressed_size(content.data)) for _, content in contents]
        parts, as_alone = payload_parts([spread.parts_alone(carriers, width, size) for size in sizes])
        start = 0
        for index, (keys, content) in enumerate(contents):
            # Spread as its own size asks: what a key shows must not depend on the sizes of other secrets.
            plan = spread.plan_spread(carriers, parts[index], width, sizes[index])
            if plan is None:
                usable = carriers / gaussians
                raise UsageError(spread.too_small(gaussians, usable, sizes[index], len(contents), width))
            self._next, end = start, start + carriers // parts[index]
            data_key = self._data_key(index)
            packed = PayloadParameters(content.method, sizes[index], plan).pack()
            self._header(keys, data_key, packed)
            encrypted = encrypt(payload_key(data_key), content.data, ASSOCIATED, size=sizes[index])
            self._whole(chunk_cipher(data_key, width), plan.encode(encrypted, end - self._next))
            start = end
        if not as_alone:
            warnings.warn(NOTICED, KeyssWarning, stacklevel=4)

    def records(self, contents: Sequence[tuple[Sequence[DerivedKey], Records]]) -> None:
        """Headers in the first carriers, records in the others; see `layout`."""
        requests = [
            RecordRequest(len(content.records), content.records.shape[1], len(content.header))
            for _, content in contents
        ]
        plans = [content.plan for _, content in contents]
        arrangement = self._room.arrangement(plans, requests)
        for index, (keys, content) in enumerate(contents):
            cells, size = content.plan.cells_per_carrier, content.records.shape[1]
            packed = RecordParameters(content.method, cells, size, content.header).pack()
            self._header(keys, self._data_key(index), packed)
        carriers = np.arange(arrangement.header_carriers, self._room.carriers)
        divided = [i for i, plan in enumerate(plans) if plan.cells_per_carrier > 1]
        whole = [i for i, plan in enumerate(plans) if plan.cells_per_carrier == 1]
        # Those that divide carriers lie in random cells of all carriers, as each would alone; what they leave
        # untouched is random too.
        if divided:
            cells = plans[divided[0]].cells_per_carrier
            free = random_order(self._entropy, "low-bits/cells", cells * len(carriers))
            touched = np.zeros(len(carriers), bool)
            for index in divided:
                count = len(contents[index][1].records) + len(contents[index][1].copied)
                own, free = free[:count], free[count:]
                order, slots = np.divmod(own, cells)
                self._place(index, contents[index][1], carriers[order], slots)
                touched[order] = True
            carriers = carriers[~touched]
        for index in whole:
            count = len(contents[index][1].records) + len(contents[index][1].copied)
            own, carriers = carriers[:count], carriers[count:]
            self._place(index, contents[index][1], own, np.zeros(count, np.int64))
        if not arrangement.as_alone:
            warnings.warn(NOTICED, KeyssWarning, stacklevel=4)

    def _place(
        self, index: int, content: Records, rows: npt.NDArray[np.int64], slots: npt.NDArray[np.int64]
    ) -> None:
        """Records, then copies, in the cells `slots` [R] of the carriers `rows` [R]."""
        count, width = content.plan.cells_per_carrier, self._room.width
        cells = as_strided(self.table, (len(self.table), count, width // count), (width, width // count, 1))
        split = len(content.records)
        every = np.arange(split)
        for label, chosen, part in (
            ("record", every, slice(split)),
            ("copy", content.copied, slice(split, None)),
        ):
            cipher = CellCipher(self._data_key(index), label, content.records.shape[1])
            place = partial(self._place_some, cipher, content.records, chosen, cells, rows[part], slots[part])
            in_blocks(place, len(chosen), _BLOCK)

    def _place_some(
        self,
        cipher: CellCipher,
        records: Bytes,
        chosen: npt.NDArray[np.int64],
        cells: Bytes,
        rows: npt.NDArray[np.int64],
        slots: npt.NDArray[np.int64],
        start: int,
        stop: int,
    ) -> None:
        """From `start` to `stop` of the `chosen` [R] records, in `cells` [carriers, slots, bytes]."""
        own, which = rows[start:stop], slots[start:stop]
        encrypted = cipher.encrypt(self._names[own], records[chosen[start:stop]], which)
        cells[own, which, : cipher.cell_bytes] = encrypted

    def _data_key(self, index: int) -> bytes:
        return expand(self._entropy, f"low-bits/data-key/{index}", DATA_KEY_BYTES)

    def _header(self, keys: Sequence[DerivedKey], data_key: bytes, packed: bytes) -> None:
        for key in keys:
            copies = np.frombuffer(data_key * KEY_COPIES, np.uint8).reshape(KEY_COPIES, -1)
            self._whole(key_cipher(key), copies)
        parts = parameters.parts_of(packed, self._room.width)
        self._whole(parameter_cipher(data_key, self._room.width), parts)

    def _whole(self, cipher: CellCipher, data: Bytes) -> None:
        """A carrier for each row of `data`; what a cell does not need of it stays noise."""
        rows = slice(self._next, self._next + len(data))
        self.table[rows, : cipher.cell_bytes] = cipher.encrypt(self._names[rows], data)
        self._next += len(data)


def digest(content: Content) -> bytes:
    """32 bytes that say which content it is."""
    if isinstance(content, Payload):
        return hashlib.sha256(content.data).digest()
    state = hashlib.sha256(content.header)
    state.update(np.ascontiguousarray(content.records).data)
    return state.digest()
