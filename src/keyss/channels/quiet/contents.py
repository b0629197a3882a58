"""Contents in carriers: written with noise everywhere else, and read with a key.

Gaussians are filled in random order and may be lost: headers have copies, and each record has its own cell.
Blocks of codes are never lost: a secret is a header, followed by the blocks of its payload.
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.lib.stride_tricks import as_strided

from keyss.channels.base import NOT_INDEPENDENT, Content, Payload, RecordPlan, Records, SaltedReader
from keyss.channels.mixing import SKETCH_BYTES, foreign, random_order, random_words, row_hashes, sketch
from keyss.channels.quiet.bits import Layout, gaussian_ids, read_low_bits
from keyss.channels.quiet.cells import CellCipher
from keyss.channels.quiet.decoded import Decoded
from keyss.channels.quiet.fields import in_counted_order, last_bits, model_hash
from keyss.channels.quiet.layout import (
    BLOCK_HEADER,
    DATA_KEY_BYTES,
    KEY_COPIES,
    LEAST_BYTES,
    MIN_BLOCKS,
    PARAMETER_COPIES,
    PAYLOAD,
    RECORDS,
    LowBitsCapacity,
    Parameters,
    key_cipher,
    numbered_chunks,
    pack_codewords,
    parameter_cipher,
    split_numbers,
    unpack,
    unpack_codewords,
)
from keyss.channels.quiet.usable import among, repeated, salt, salt_rows
from keyss.channels.quiet.wet_paper import block_ids, read_blocks
from keyss.core.arrays import Bytes, Flags, Integers
from keyss.core.errors import InputError, KeyssWarning, UsageError, WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.files.formats.common import CodedGaussians, Codes
from keyss.keys.derivation import DerivedKey, expand, fill
from keyss.keys.encryption import OVERHEAD, compressed_size, decrypt, encrypt, encrypted_size

_ASSOCIATED = b"keyss/v1/quiet"  # authenticated with a payload
_AT_ONCE = 1 << 18  # records that are encrypted at a time
_NO_COPIES: Integers = np.zeros(0, np.int64)


class Writer:
    """The bytes of carriers with `ids` [C, 16], `width` bytes each, in a model of `gaussians`.

    `entropy`: 32 secret bytes. `sketched`: IDs [N, 16] of all Gaussians; None if carriers are blocks.
    """

    def __init__(
        self, ids: Bytes, width: int, entropy: bytes, gaussians: int, sketched: Bytes | None = None
    ) -> None:
        self._entropy, self._gaussians, self._sketched = entropy, gaussians, sketched
        self._blocks = sketched is None
        self._capacity = LowBitsCapacity(len(ids), width)
        self.order = np.arange(len(ids)) if self._blocks else random_order(entropy, "quiet/order", len(ids))
        self._ids = ids[self.order]  # [C, 16] in the order of `table`
        self.table = np.empty((len(ids), width), np.uint8)
        fill(entropy, "quiet/noise", self.table)

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
        independent = all(each.plan.independent for each in records)
        if payloads:
            sizes = [encrypted_size(compressed_size(each.data)) for each in payloads]
            plans, independent = self._capacity.plan_payloads(sizes)
            for index, (payload, size) in enumerate(zip(payloads, sizes, strict=True)):
                per_carrier, cells, codewords = plans[index]
                chunks = numbered_chunks(codewords, self._encrypted(index, payload, size), cells)
                plan = RecordPlan(chunks.shape[1], 0, per_carrier)
                header = pack_codewords(size, codewords)
                records.append(Records(payload.method, header, chunks, plan, _NO_COPIES))
        service, at = PAYLOAD if payloads else RECORDS, 0
        for index, ((keys, _), each) in enumerate(zip(contents, records, strict=True)):
            at = self._header(at, index, keys, each, service)
        self._place_all(records, self._capacity.reserved([len(each.header) for each in records], independent))
        if not independent and len(contents) > 1:
            warnings.warn(NOT_INDEPENDENT, KeyssWarning, stacklevel=4)

    def _write_blocks(self, keys: Sequence[DerivedKey], payloads: Sequence[Payload]) -> None:
        """Each secret takes consecutive blocks, cyclically; all arrangements are equally likely."""
        width, count = self._capacity.width, self._capacity.carriers
        takes = [BLOCK_HEADER + -(-(compressed_size(each.data) + OVERHEAD) // width) for each in payloads]
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
        return encrypt(payload_key(self._data_key(index)), payload.data, _ASSOCIATED, size=size)

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
            b"" if self._sketched is None else sketch(data_key, self._sketched),
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


@dataclass(frozen=True)
class QuietReader(SaltedReader):
    """Reads the carriers of a stego model; copies of a Gaussian with equal low bits count once."""

    ids: Bytes  # [C, 16]
    low: Bytes  # [C, B]
    salts: Sequence[bytes]
    widths: Sequence[int]  # bytes of a carrier that parameters may take; empty without capacity
    blocks: bool = False  # the carriers are blocks of codes

    @staticmethod
    def of(stego: Gaussians) -> QuietReader | None:
        """The reader of the codes of a coded or decoded model, else of low bits; None without capacity."""
        if isinstance(stego, CodedGaussians):
            return QuietReader.of_codes(stego.codes)
        if decoded := Decoded.of(stego):
            return QuietReader.of_codes(decoded.codes, decoded)
        layout = Layout.of(stego)
        ids, low = gaussian_ids(stego, layout), read_low_bits(stego, layout)
        rows = _unique_rows(ids, low)
        if len(rows) < len(ids):
            stego, ids, low = stego[torch.from_numpy(rows)], ids[rows], low[rows]
        salts = [salt(ids[row], low[row]) for row in salt_rows(stego, ids, layout)]
        narrow = replace(layout, written_degree=min(1, layout.sh_degree))
        widths = dict.fromkeys((layout.width, narrow.width))
        return QuietReader(ids, low, salts, [each for each in widths if LowBitsCapacity(0, each).part_bytes])

    @staticmethod
    def of_codes(codes: Codes, decoded: Decoded | None = None) -> QuietReader | None:
        """None for codes without capacity. `decoded`: the model that was decoded from them."""
        rows, ordered, fields = in_counted_order(codes, decoded.exact if decoded else None)
        low = read_blocks(last_bits(fields))
        if len(low) < MIN_BLOCKS:
            return None
        ids = block_ids(len(low), model_hash(ordered, decoded[rows].model if decoded else None))
        return QuietReader(ids[1:], low[1:], [salt(ids[0], low[0, :LEAST_BYTES])], [LEAST_BYTES], True)

    def extract(self, key: DerivedKey) -> Content:
        """`open` after key derivation under one salt, without a warning.

        A wrong key makes the same passes over all cells, with a data key that matches nothing.
        """
        data_key, found, width, at = self._parameters(key)
        if self.blocks:
            return self._in_blocks(data_key, found, at)
        foreign_count = foreign(data_key, self.ids, found.sketch, found.gaussians)
        cell = LowBitsCapacity(0, width).record_bytes(found.cells)
        if not 0 < found.record_bytes <= cell:
            raise InputError("the hidden parameters are damaged: records larger than their cells")
        cipher = CellCipher(data_key, "record", found.record_bytes)
        records, full = self._decrypt(cipher, width, found.cells)
        if found.service == PAYLOAD:
            size, codewords = unpack_codewords(found.header, found.record_bytes)
            numbers, chunks = split_numbers(records)
            encrypted = codewords.decode(numbers, chunks)[:size]
            left = len(np.unique(numbers[numbers < codewords.chunks]))
            data = decrypt(payload_key(data_key), encrypted, _ASSOCIATED)
            return Payload(found.method, data, (left, codewords.chunks), foreign=foreign_count)
        cipher = CellCipher(data_key, "copy", found.record_bytes)
        copies, _ = self._decrypt(cipher, width, found.cells, full)
        records = np.concatenate([records, copies[~_rows_in(copies, records)]])
        if not len(records):
            raise InputError("the key is right, but nothing is left of its secret")
        plan = RecordPlan(cell, 0, found.cells)
        return Records(found.method, found.header, records, plan, np.zeros(0, np.int64), foreign_count)

    def _in_blocks(self, data_key: bytes, found: Parameters, at: int) -> Payload:
        """The payload in the blocks after block `at`, which holds its parameters."""
        if found.count > len(self.low) or not 0 < found.record_bytes <= self.low.shape[1]:
            raise InputError("the hidden parameters are damaged: the data they describe exceed the file")
        rows = (at + 1 + np.arange(found.count)) % len(self.low)
        encrypted = self.low[rows, : found.record_bytes].tobytes()
        return Payload(found.method, decrypt(payload_key(data_key), encrypted, _ASSOCIATED))

    def _parameters(self, key: DerivedKey) -> tuple[bytes, Parameters, int, int]:
        """The data key, the parameters, the width of a carrier, and the last carrier of the parameters."""
        if not self.widths:
            raise WrongKeyError()
        whole = self.low.shape[1]
        votes = Counter(row.tobytes() for row in self._decrypt(key_cipher(key), whole)[0]).most_common(1)
        data_key = votes[0][0] if votes else key.expand("quiet/none", DATA_KEY_BYTES)
        found = [self._decrypt(parameter_cipher(data_key, width), whole) for width in self.widths]
        for width, (parts, fitting) in zip(self.widths, found, strict=True):
            if len(parts):
                unpacked = unpack(parts, 0 if self.blocks else SKETCH_BYTES)
                return data_key, unpacked, width, int(np.flatnonzero(fitting)[-1])
        # The tag of a key cell is valid by chance with probability 2^-32.
        self._decrypt(CellCipher(data_key, "record", LowBitsCapacity(0, whole).record_bytes(1)), whole)
        raise WrongKeyError()

    def _decrypt(
        self, cipher: CellCipher, width: int, cells: int = 1, full: Flags | None = None
    ) -> tuple[Bytes, Flags]:
        """Data [M, size] of the cells with a valid tag, in the order of carriers, and their mask [cells, N].

        `width`: bytes of a carrier. `full`: cells to skip, the mask of an earlier call.
        """
        size, found = width // cells, []
        fitting = np.zeros((cells, len(self.low)), bool)
        for slot, fits in enumerate(fitting):
            rows: slice | Integers = slice(None) if full is None else np.flatnonzero(~full[slot])
            own = self.low[rows, slot * size : (slot + 1) * size]
            fits[rows], data = cipher.decrypt(self.ids[rows], own, slot)
            found.append(data)
        if cells == 1:
            return found[0], fitting
        order = np.concatenate([*map(np.flatnonzero, fitting)]).argsort(kind="stable")
        return np.concatenate(found)[order], fitting


def payload_key(data_key: bytes) -> bytes:
    """The key that encrypts a payload, before it is cut into chunks."""
    return expand(data_key, "payload-key", 32)


def bytes_of(content: Content) -> bytes:
    """The bytes of a content."""
    return content.data if isinstance(content, Payload) else content.header + content.records.tobytes()


def _unique_rows(ids: Bytes, low: Bytes) -> Integers:
    """Rows [M] that differ in `ids` [N, 16] or `low` bits [N, B]."""
    repeats = np.flatnonzero(repeated(ids.view("<u8")[:, 0]))
    if not len(repeats):
        return np.arange(len(ids))
    whole = np.concatenate([ids[repeats], low[repeats]], axis=1)
    _, first = np.unique(whole.view(f"S{whole.shape[1]}")[:, 0], return_index=True)
    return np.setdiff1d(np.arange(len(ids)), np.delete(repeats, first))


def _rows_in(rows: Bytes, others: Bytes) -> Flags:
    """Mask [R] of the rows [R, C] that are among the others [O, C], by their hashes."""
    wanted, known = map(row_hashes, (rows, others))
    return among(wanted, np.sort(known))
