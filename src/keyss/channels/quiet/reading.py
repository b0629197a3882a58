"""Read the carriers of a model with a key."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from keyss.channels.base import Content, Payload, RecordPlan, Records, SaltedReader
from keyss.channels.mixing import row_hashes
from keyss.channels.quiet import parameters
from keyss.channels.quiet.bits import Layout, gaussian_ids, read_low_bits
from keyss.channels.quiet.cells import CellCipher
from keyss.channels.quiet.decoded import Decoded
from keyss.channels.quiet.fields import in_counted_order, last_bits, model_hash
from keyss.channels.quiet.layout import (
    DATA_KEY_BYTES,
    LEAST_BYTES,
    MIN_BLOCKS,
    LowBitsCapacity,
    split_numbers,
)
from keyss.channels.quiet.parameters import Parameters, key_cipher, parameter_cipher
from keyss.channels.quiet.usable import among, repeated, salt, salt_rows
from keyss.channels.quiet.wet_paper import block_ids, read_blocks
from keyss.channels.quiet.writing import ASSOCIATED, payload_key
from keyss.channels.sketch import SKETCH_BYTES, foreign
from keyss.core.arrays import Bytes, Flags, Integers
from keyss.core.errors import InputError, WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.files.formats.common import CodedGaussians, Codes
from keyss.keys.derivation import DerivedKey
from keyss.keys.encryption import decrypt


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
        if found.service == parameters.PAYLOAD:
            size, codewords = parameters.unpack_codewords(found.header, found.record_bytes)
            numbers, chunks = split_numbers(records)
            encrypted = codewords.decode(numbers, chunks)[:size]
            left = len(np.unique(numbers[numbers < codewords.chunks]))
            data = decrypt(payload_key(data_key), encrypted, ASSOCIATED)
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
        return Payload(found.method, decrypt(payload_key(data_key), encrypted, ASSOCIATED))

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
                unpacked = parameters.unpack(parts, 0 if self.blocks else SKETCH_BYTES)
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
