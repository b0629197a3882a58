"""What a key opens in the carriers of a model."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from keyss.channels.base import Content, Payload, RecordPlan, Records, SaltedReader
from keyss.channels.mixing import row_hashes
from keyss.channels.quiet import parameters
from keyss.channels.quiet.bits import Layout, identities, read_low_bits
from keyss.channels.quiet.cells import CellCipher
from keyss.channels.quiet.decoded import Decoded
from keyss.channels.quiet.fields import last_bits
from keyss.channels.quiet.kept import host_of, in_counted_order
from keyss.channels.quiet.layout import DATA_KEY_BYTES, LEAST_BYTES, MIN_BLOCKS, LowBitsRoom, split_numbers
from keyss.channels.quiet.parameters import Parameters, key_cipher, parameter_cipher
from keyss.channels.quiet.salts import salt, salt_rows
from keyss.channels.quiet.syndromes import block_names, held
from keyss.channels.quiet.usable import among, repeated
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
    """The carriers of a stego model; a Gaussian that occurs twice with equal low bits counts once."""

    names: Bytes  # [C, 16] identities
    low: Bytes  # [C, B]
    salts: Sequence[bytes]
    widths: Sequence[int]  # bytes of a carrier that parameters may take; none where there is no room
    blocks: bool = False  # the carriers are blocks of codes

    @staticmethod
    def of(stego: Gaussians) -> QuietReader | None:
        """The reader of the codes of a coded or decoded model, else of low bits; None without room."""
        if isinstance(stego, CodedGaussians):
            return QuietReader.of_codes(stego.codes)
        if decoded := Decoded.of(stego):
            return QuietReader.of_codes(decoded.codes, decoded)
        layout = Layout.of(stego)
        names, low = identities(stego, layout), read_low_bits(stego, layout)
        rows = _first_of_each(names, low)
        if len(rows) < len(names):
            stego, names, low = stego[torch.from_numpy(rows)], names[rows], low[rows]
        salts = [salt(names[row], low[row]) for row in salt_rows(stego, names, low, layout)]
        narrow = replace(layout, written_degree=min(1, layout.sh_degree))
        widths = dict.fromkeys((layout.width, narrow.width))
        return QuietReader(names, low, salts, [each for each in widths if LowBitsRoom(0, each).part_bytes])

    @staticmethod
    def of_codes(codes: Codes, decoded: Decoded | None = None) -> QuietReader | None:
        """None for codes without room. `decoded`: the model that was decoded from them."""
        rows, ordered, fields = in_counted_order(codes, decoded.exact if decoded else None)
        low = held(last_bits(fields))
        if len(low) < MIN_BLOCKS:
            return None
        names = block_names(len(low), host_of(ordered, decoded[rows].model if decoded else None))
        return QuietReader(names[1:], low[1:], [salt(names[0], low[0, :LEAST_BYTES])], [LEAST_BYTES], True)

    def extract(self, key: DerivedKey) -> Content:
        """`open` after key derivation under one salt, without a warning.

        A key that opens nothing makes the same passes over all cells, under a data key that fits nothing.
        """
        data_key, found, width, at = self._parameters(key)
        if self.blocks:
            return self._in_blocks(data_key, found, at)
        strangers = foreign(data_key, self.names, found.sketch, found.gaussians)
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
            return Payload(found.method, data, (left, codewords.chunks), foreign=strangers)
        cipher = CellCipher(data_key, "copy", found.record_bytes)
        copies, _ = self._decrypt(cipher, width, found.cells, full)
        records = np.concatenate([records, copies[~_are_among(copies, records)]])
        if not len(records):
            raise InputError("the key is right, but nothing is left of what it opens")
        plan = RecordPlan(room, 0, found.cells)
        return Records(found.method, found.header, records, plan, np.zeros(0, np.int64), strangers)

    def _in_blocks(self, data_key: bytes, found: Parameters, at: int) -> Payload:
        """The payload in the blocks after `at`, where its parameters are."""
        if found.count > len(self.low) or not 0 < found.record_bytes <= self.low.shape[1]:
            raise InputError("the hidden parameters are damaged: the data they describe exceed the file")
        rows = (at + 1 + np.arange(found.count)) % len(self.low)
        encrypted = self.low[rows, : found.record_bytes].tobytes()
        return Payload(found.method, decrypt(payload_key(data_key), encrypted, ASSOCIATED))

    def _parameters(self, key: DerivedKey) -> tuple[bytes, Parameters, int, int]:
        """The data key, the parameters, the bytes of a carrier, and the last carrier of the parameters."""
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
        # By chance the tag of a key cell fits once in 2^32.
        self._decrypt(CellCipher(data_key, "record", LowBitsRoom(0, whole).record_bytes(1)), whole)
        raise WrongKeyError()

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
            fits[rows], data = cipher.decrypt(self.names[rows], own, slot)
            found.append(data)
        if cells == 1:
            return found[0], fitting
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
