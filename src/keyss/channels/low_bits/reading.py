"""Reading what lies in the low bits of a model, with a key."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from keyss.channels.base import Bytes, Content, Payload, RecordPlan, Records
from keyss.channels.low_bits import parameters
from keyss.channels.low_bits.bits import Flags, Layout, identities, read_low_bits
from keyss.channels.low_bits.cells import TAG_BYTES, CellCipher
from keyss.channels.low_bits.ciphers import (
    ASSOCIATED,
    chunk_cipher,
    key_cipher,
    parameter_cipher,
    payload_key,
)
from keyss.channels.low_bits.layout import DATA_KEY_BYTES, Carriers
from keyss.channels.low_bits.parameters import RecordParameters
from keyss.channels.low_bits.salts import salt, salt_rows
from keyss.channels.low_bits.spread import chunk_bytes
from keyss.channels.low_bits.usable import repeated
from keyss.core.errors import InputError, WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.keys.derivation import DerivedKey, KeyDerivation
from keyss.keys.encryption import decrypt

SALTS_TRIED = 4  # of a model half of whose Gaussians were changed, 15 of 16 then open


@dataclass(frozen=True)
class LowBitsReader:
    """A stego model as a reader sees it; a Gaussian that occurs twice with equal low bits counts once."""

    identities: Bytes  # [N, 16]
    low: Bytes  # [N, B] low bits
    salts: list[bytes]  # the likeliest first

    @staticmethod
    def of(stego: Gaussians) -> LowBitsReader:
        layout = Layout.of(stego)
        names, low = identities(stego, layout), read_low_bits(stego, layout)
        rows = _first_of_each(names, low)
        if len(rows) < len(names):
            stego, names, low = stego[torch.from_numpy(rows)], names[rows], low[rows]
        salts = [salt(names[row], low[row]) for row in salt_rows(stego, names, low, layout)]
        return LowBitsReader(names, low, salts)

    def keys(self, key: str, most: int = SALTS_TRIED) -> Iterator[DerivedKey]:
        """What `key` becomes under each salt to be tried, the likeliest first; each takes 0.1 s."""
        return (DerivedKey(key, KeyDerivation(salt=each)) for each in self.salts[:most])

    def open(self, key: str) -> Content:
        """What `key` opens. Raises WrongKeyError and InputError.

        If the first salt opens nothing others are tried, SALTS_TRIED in all: changed or added Gaussians may
        have taken the first ones' places, and should not lock out the key.
        """
        for derived in self.keys(key):
            with suppress(WrongKeyError):
                return self.extract(derived)
        raise WrongKeyError()

    def extract(self, key: DerivedKey) -> Content:
        """The content under this key and its salt. Raises WrongKeyError and InputError.

        A key that opens nothing makes the same passes over all cells, under a data key that fits nothing.
        """
        if Carriers(0, self._width).part_bytes == 0:
            raise WrongKeyError()
        found = self._decrypt(key_cipher(key))
        votes = Counter(row.tobytes() for row in found).most_common(1)
        data_key = votes[0][0] if votes else key.expand("low-bits/none", DATA_KEY_BYTES)
        parts = self._decrypt(parameter_cipher(data_key, self._width))
        if not len(parts):  # by chance the tag of a key cell fits once in 2^32
            self._decrypt(chunk_cipher(data_key, self._width))
            raise WrongKeyError()
        read = parameters.unpack(parts, chunk_bytes(self._width))
        if isinstance(read, RecordParameters):
            return self._records(read, data_key)
        chunks = self._decrypt(chunk_cipher(data_key, self._width))
        data = decrypt(payload_key(data_key), read.spread.decode(chunks, read.size), ASSOCIATED)
        return Payload(read.method, data, read.spread.left(chunks))

    @property
    def _width(self) -> int:
        return int(self.low.shape[1])

    def _records(self, found: RecordParameters, data_key: bytes) -> Records:
        room = self._width // found.cells - TAG_BYTES
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


def _first_of_each(names: Bytes, low: Bytes) -> npt.NDArray[np.int64]:
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
