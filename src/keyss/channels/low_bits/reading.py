"""Reading what lies in the low bits of a model, with a key."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from keyss.channels.base import Bytes, Content, Payload, RecordPlan, Records
from keyss.channels.low_bits import parameters
from keyss.channels.low_bits.bits import KERNEL_BLOCK, Flags, Layout, identities, read_low_bits
from keyss.channels.low_bits.cells import TAG_BYTES, CellCipher
from keyss.channels.low_bits.ciphers import (
    ASSOCIATED,
    chunk_cipher,
    key_cipher,
    parameter_cipher,
    payload_key,
)
from keyss.channels.low_bits.layout import DATA_KEY_BYTES, Room
from keyss.channels.low_bits.multiples import repeated
from keyss.channels.low_bits.parameters import PayloadParameters, RecordParameters
from keyss.channels.low_bits.salts import salt, salt_rows
from keyss.channels.low_bits.spread import chunk_bytes
from keyss.channels.mixing import mixed
from keyss.core.errors import InputError, KeyssWarning, WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.keys.derivation import DerivedKey, KeyDerivation
from keyss.keys.encryption import decrypt
from keyss.rendering.cpu.parallel import in_blocks

SALTS_TRIED = 4  # of a model half of whose Gaussians were changed, 15 of 16 then open
_OPENS_NOTHING = "this key opens nothing here"


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
        have taken the first ones' places, and should not lock out the key. Warns if the key opens something
        else too, as where two files were put together.
        """
        for derived in self.keys(key):
            with suppress(WrongKeyError):
                data_key, found = self._found(derived)
                content = self._content(data_key, found)
                self._warn_of_others(key, data_key, found, content)
                return content
        raise WrongKeyError(_OPENS_NOTHING)

    def extract(self, key: DerivedKey) -> Content:
        """The content under this key and its salt. Raises WrongKeyError and InputError.

        A key that opens nothing makes the same passes over all cells, under a data key that fits nothing.
        """
        return self._content(*self._found(key))

    @property
    def _width(self) -> int:
        return int(self.low.shape[1])

    def _found(self, key: DerivedKey) -> tuple[bytes, PayloadParameters | RecordParameters]:
        """The data key, and how what it opens is to be read."""
        if Room(0, self._width).part_bytes == 0:
            raise WrongKeyError(_OPENS_NOTHING)
        found = self._decrypt(key_cipher(key))
        votes = Counter(row.tobytes() for row in found).most_common(1)
        data_key = votes[0][0] if votes else key.expand("low-bits/none", DATA_KEY_BYTES)
        parts = self._decrypt(parameter_cipher(data_key, self._width))
        if not len(parts):  # by chance the tag of a key cell fits once in 2^32
            self._decrypt(chunk_cipher(data_key, self._width))
            raise WrongKeyError(_OPENS_NOTHING)
        return data_key, parameters.unpack(parts, chunk_bytes(self._width))

    def _content(self, data_key: bytes, found: PayloadParameters | RecordParameters) -> Content:
        if isinstance(found, PayloadParameters):
            return self._payload(found, data_key)
        return self._records(found, data_key)

    def _payload(self, found: PayloadParameters, data_key: bytes) -> Payload:
        chunks = self._decrypt(chunk_cipher(data_key, self._width))
        encrypted = found.spread.decode(chunks, found.size)
        data = decrypt(payload_key(data_key), encrypted, ASSOCIATED)
        return Payload(found.method, data, found.spread.left(chunks))

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

    def _warn_of_others(
        self,
        key: str,
        data_key: bytes,
        found: PayloadParameters | RecordParameters,
        content: Content,
    ) -> None:
        """Under salts that were not there when `found` was written."""
        foreign = [each for each in self.salts if each[0] not in found.salts]
        for each in foreign[:SALTS_TRIED]:
            with suppress(WrongKeyError, InputError):
                other_key, other = self._found(DerivedKey(key, KeyDerivation(salt=each)))
                if other_key != data_key:
                    warnings.warn(
                        f"this key opens two secrets here, {_described(content)} and "
                        f"{_described(self._content(other_key, other))}: the model was put together from two "
                        "files; what comes out is the first, and the second one's file opens it alone",
                        KeyssWarning,
                        stacklevel=3,
                    )
                    return


def _described(content: Content) -> str:
    if isinstance(content, Payload):
        return f"{len(content.data):,} bytes of the method {content.method!r}"
    return f"{len(content.records):,} records of the method {content.method!r}"


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
    own, theirs = _hashes(rows), _hashes(others)
    order, mine = np.argsort(theirs), np.argsort(own)
    place = np.empty(len(own), np.int64)
    place[mine] = np.searchsorted(theirs[order], own[mine]).clip(max=max(0, len(theirs) - 1))
    maybe = np.flatnonzero(theirs[order[place]] == own) if len(theirs) else np.zeros(0, np.int64)
    found = np.zeros(len(rows), bool)
    found[maybe] = (rows[maybe] == others[order[place[maybe]]]).all(axis=1)
    unsure = maybe[~found[maybe]]  # another row with the same hash: one in 2^64, or somebody's doing
    if len(unsure):
        code = f"S{rows.shape[1]}"  # bytes of a fixed length: zeros at their end make no difference
        found[unsure] = np.isin(rows[unsure].view(code)[:, 0], others.view(code)[:, 0])
    return found


def _hashes(rows: Bytes) -> npt.NDArray[np.uint64]:
    """[R] of rows [R, C]."""
    states = np.zeros(len(rows), np.uint64)

    def hash_some(start: int, stop: int) -> None:
        padded = np.zeros((stop - start, -(-rows.shape[1] // 8) * 8), np.uint8)
        padded[:, : rows.shape[1]] = rows[start:stop]
        for word in padded.view("<u8").T:
            states[start:stop] = mixed(states[start:stop] ^ word)

    in_blocks(hash_some, len(rows), KERNEL_BLOCK)
    return states
