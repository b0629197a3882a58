"""Reading the low bits of a model with a key."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
import torch

from keyss.channels.base import SALTS_TRIED, Content, Payload, RecordPlan, Records, SaltedReader
from keyss.channels.low_bits import parameters
from keyss.channels.low_bits.bits import Layout, identities, read_low_bits
from keyss.channels.low_bits.cells import CellCipher
from keyss.channels.low_bits.layout import DATA_KEY_BYTES, LowBitsRoom
from keyss.channels.low_bits.parameters import Parameters, key_cipher, parameter_cipher
from keyss.channels.low_bits.salts import salt, salt_rows
from keyss.channels.low_bits.spread import split_numbers
from keyss.channels.low_bits.usable import repeated
from keyss.channels.low_bits.writing import ASSOCIATED, payload_key
from keyss.core.arrays import Bytes, Flags, Integers
from keyss.core.errors import InputError, KeyssWarning, WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.keys.derivation import DerivedKey
from keyss.keys.encryption import decrypt

_TWO_SECRETS = (
    "this key opens two secrets, because the model was merged from two files: the first one comes out, and "
    "the second one opens from its own file"
)


@dataclass(frozen=True)
class LowBitsReader(SaltedReader):
    """A stego model as a reader sees it; a Gaussian that occurs twice with equal low bits counts once."""

    identities: Bytes  # [N, 16]
    low: Bytes  # [N, B] low bits
    salts: Sequence[bytes]

    @staticmethod
    def of(stego: Gaussians) -> LowBitsReader:
        layout = Layout.of(stego)
        names, low = identities(stego, layout), read_low_bits(stego, layout)
        rows = _first_of_each(names, low)
        if len(rows) < len(names):
            stego, names, low = stego[torch.from_numpy(rows)], names[rows], low[rows]
        salts = [salt(names[row], low[row]) for row in salt_rows(stego, names, low, layout)]
        return LowBitsReader(names, low, salts)

    def open(self, key: str) -> Content:
        """See `Reader`. Warns (KeyssWarning) if the key opens two secrets, as where two files were merged."""
        for derived in self.keys(key):
            with suppress(WrongKeyError):
                data_key, found = self._parameters(derived)
                content = self._content(data_key, found)
                self._warn_of_another(key, data_key, found.salts)
                return content
        raise WrongKeyError()

    def extract(self, key: DerivedKey) -> Content:
        """`open` after key derivation under one salt.

        A key that opens nothing makes the same passes over all cells, under a data key that fits nothing.
        """
        return self._content(*self._parameters(key))

    def _parameters(self, key: DerivedKey) -> tuple[bytes, Parameters]:
        """The data key and the parameters."""
        room = LowBitsRoom(0, self._width)
        if room.part_bytes == 0:
            raise WrongKeyError()
        votes = Counter(row.tobytes() for row in self._decrypt(key_cipher(key))).most_common(1)
        data_key = votes[0][0] if votes else key.expand("low-bits/none", DATA_KEY_BYTES)
        parts = self._decrypt(parameter_cipher(data_key, self._width))
        if not len(parts):  # by chance the tag of a key cell fits once in 2^32
            self._decrypt(CellCipher(data_key, "record", room.record_bytes(1)))
            raise WrongKeyError()
        return data_key, parameters.unpack(parts)

    def _content(self, data_key: bytes, found: Parameters) -> Content:
        room = LowBitsRoom(0, self._width).record_bytes(found.cells)
        if not 0 < found.record_bytes <= room:
            raise InputError("the hidden parameters are damaged: records larger than their cells")
        records = self._decrypt(CellCipher(data_key, "record", found.record_bytes), found.cells)
        if found.service == parameters.PAYLOAD:
            size, codewords = parameters.unpack_codewords(found.header, found.record_bytes)
            numbers, chunks = split_numbers(records)
            encrypted = codewords.decode(numbers, chunks)[:size]
            left = len(np.unique(numbers[numbers < codewords.chunks]))
            data = decrypt(payload_key(data_key), encrypted, ASSOCIATED)
            return Payload(found.method, data, (left, codewords.chunks))
        copies = self._decrypt(CellCipher(data_key, "copy", found.record_bytes), found.cells)
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

    @property
    def _width(self) -> int:
        return int(self.low.shape[1])

    def _decrypt(self, cipher: CellCipher, cells: int = 1) -> Bytes:
        """[M, size] the data that fit in any of the `cells` of each carrier, in the order of carriers."""
        size = self._width // cells
        found = [
            cipher.decrypt(self.identities, self.low[:, slot * size : (slot + 1) * size], slot)
            for slot in range(cells)
        ]
        if cells == 1:
            return found[0][1]
        fits = np.stack([each for each, _ in found], axis=1)
        places = np.cumsum(fits).reshape(fits.shape) - 1
        rows = np.empty((int(places[-1, -1]) + 1 if fits.size else 0, cipher.size), np.uint8)
        for slot, (fit, data) in enumerate(found):
            rows[places[fit, slot]] = data
        return rows


def _first_of_each(names: Bytes, low: Bytes) -> Integers:
    """[M] rows of identities `names` [N, 16] and `low` bits [N, B], equal ones only once."""
    doubtful = np.flatnonzero(repeated(names.view("<u8")[:, 0]))
    if not len(doubtful):
        return np.arange(len(names))
    whole = np.concatenate([names[doubtful], low[doubtful]], axis=1)
    _, first = np.unique(whole.view(f"S{whole.shape[1]}")[:, 0], return_index=True)
    return np.setdiff1d(np.arange(len(names)), np.delete(doubtful, first))


def _are_among(rows: Bytes, others: Bytes) -> Flags:
    """[R] which of the rows [R, C] are there among the others [O, C]."""
    known = {each.tobytes() for each in rows}.intersection(each.tobytes() for each in others)
    return np.fromiter((each.tobytes() in known for each in rows), bool, len(rows))
