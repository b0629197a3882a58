"""Payloads in carriers: written with noise everywhere else, and read with a key.

Gaussians may be lost: a header is repeated, a payload has redundancy, and both lie in random order. Blocks of
codes are never lost: a secret is a header, followed by the blocks of its payload.
"""

from __future__ import annotations

import math
import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from keyss.channels.base import NOT_INDEPENDENT, Payload, SaltedReader
from keyss.channels.mixing import foreign_share, random_order, random_words, sketch
from keyss.channels.quiet.bits import Layout, gaussian_ids, read_low_bits
from keyss.channels.quiet.cells import CellCipher
from keyss.channels.quiet.decoded import Decoded
from keyss.channels.quiet.fields import in_counted_order, last_bits, model_hash
from keyss.channels.quiet.quiet_header import (
    BLOCK_HEADER,
    DATA_KEY_BYTES,
    KEY_COPIES,
    LEAST_BYTES,
    MIN_BLOCKS,
    PARAMETER_COPIES,
    LowBitsCapacity,
    Parameters,
    chunk_cipher,
    key_cipher,
    numbered_chunks,
    parameter_cipher,
    split_numbers,
    unpack,
)
from keyss.channels.quiet.usable import repeated, salt, salt_rows
from keyss.channels.quiet.wet_paper import block_ids, read_blocks
from keyss.core.arrays import Bytes, Flags, Integers
from keyss.core.errors import InputError, KeyssWarning, UsageError, WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.files.formats.common import CodedGaussians, Codes
from keyss.keys.derivation import DerivedKey, expand, fill
from keyss.keys.encryption import OVERHEAD, compressed_size, decrypt, encrypt

_ASSOCIATED = b"keyss/v1/quiet"  # authenticated with a payload


class Writer:
    """Fills `table` [C, width], the bytes of the carriers in `order` [C], with payloads and noise.

    `ids` [C, 16]: of the carriers. `entropy`: 32 secret bytes. `gaussians`: size of the model. `sketched`:
    IDs [N, 16] of all Gaussians; None if carriers are blocks.
    """

    def __init__(
        self, ids: Bytes, width: int, entropy: bytes, gaussians: int, sketched: Bytes | None = None
    ) -> None:
        self._entropy, self._gaussians, self._sketched = entropy, gaussians, sketched
        self._capacity = LowBitsCapacity(len(ids), width)
        blocks = sketched is None
        self.order = np.arange(len(ids)) if blocks else random_order(entropy, "quiet/order", len(ids))
        self._ids = ids[self.order]  # [C, 16] in the order of `table`
        self.table = np.empty((len(ids), width), np.uint8)
        fill(entropy, "quiet/noise", self.table)

    def write(self, payloads: Sequence[tuple[Sequence[DerivedKey], Payload]]) -> None:
        """Write headers and payloads. Raises UsageError for too large payloads.

        Each payload comes with its key under every salt that is not stale.
        """
        sizes = [compressed_size(payload.data) + OVERHEAD for _, payload in payloads]
        if self._sketched is None:
            self._write_blocks(payloads, sizes)
        else:
            self._write_chunks(payloads, sizes, self._sketched)

    def _write_chunks(
        self, payloads: Sequence[tuple[Sequence[DerivedKey], Payload]], sizes: Sequence[int], sketched: Bytes
    ) -> None:
        """Headers go into the first rows of `table`, chunks into random ones of the others."""
        plan, at, width = self._capacity.plan(sizes), 0, self._capacity.width
        free = plan.first + random_order(self._entropy, "quiet/chunks", len(self.table) - plan.first)
        for index, ((keys, payload), size) in enumerate(zip(payloads, sizes, strict=True)):
            data_key, (count, codewords) = self._data_key(index), plan.shares[index]
            own_sketch = sketch(data_key, sketched)
            parameters = Parameters(payload.method, size, 0, codewords, self._gaussians, own_sketch)
            at = self._write_header(at, data_key, keys, parameters)
            chunks = numbered_chunks(codewords, self._encrypt(data_key, payload, size), count)
            rows, free = free[:count], free[count:]
            cipher = chunk_cipher(data_key, width)
            self.table[rows, : cipher.cell_bytes] = cipher.encrypt(self._ids[rows], chunks)
        if not plan.independent and len(payloads) > 1:
            warnings.warn(NOT_INDEPENDENT, KeyssWarning, stacklevel=5)

    def _write_blocks(
        self, payloads: Sequence[tuple[Sequence[DerivedKey], Payload]], sizes: Sequence[int]
    ) -> None:
        """Each secret takes consecutive blocks, cyclically; all arrangements are equally likely."""
        width, count = self._capacity.width, self._capacity.carriers
        takes = [BLOCK_HEADER + -(-size // width) for size in sizes]
        if (free := count - sum(takes)) < 0:
            raise UsageError(
                f"the secrets take {width * sum(takes):,} bytes, and this cover of {self._gaussians:,} "
                f"Gaussians has room for {width * count:,}"
            )
        first, *gaps = random_words(self._entropy, "quiet/gaps", len(payloads) + 1).tolist()
        gaps = sorted(gap % (free + 1) for gap in gaps)
        for index in random_order(self._entropy, "quiet/along", len(payloads)).tolist():
            (keys, payload), data_key = payloads[index], self._data_key(index)
            size = width * (takes[index] - BLOCK_HEADER)
            rows = np.frombuffer(self._encrypt(data_key, payload, size), np.uint8).reshape(-1, width)
            parameters = Parameters(payload.method, size, width)
            at = self._write_header((first + gaps.pop(0)) % count, data_key, keys[:1], parameters)
            self.table[(at + np.arange(len(rows))) % count] = rows
            first += takes[index]

    def _encrypt(self, data_key: bytes, payload: Payload, size: int) -> bytes:
        return encrypt(payload_key(data_key), payload.data, _ASSOCIATED, size=size)

    def _data_key(self, index: int) -> bytes:
        return expand(self._entropy, f"quiet/data-key/{index}", DATA_KEY_BYTES)

    def _write_header(
        self, at: int, data_key: bytes, keys: Sequence[DerivedKey], parameters: Parameters
    ) -> int:
        """Write a header into the rows of `table` from `at` on; returns the row after it."""
        blocks = parameters.codewords is None
        key_copies, part_copies = (1, 1) if blocks else (KEY_COPIES, PARAMETER_COPIES)
        width = LEAST_BYTES if blocks else self._capacity.width
        data_keys = np.frombuffer(data_key * key_copies, np.uint8).reshape(key_copies, -1)
        cells = [(key_cipher(key), data_keys) for key in keys]
        parts = np.tile(parameters.parts(width), (part_copies, 1))
        for cipher, data in (*cells, (parameter_cipher(data_key, width), parts)):
            rows = (at + np.arange(len(data))) % len(self.table)
            self.table[rows, : cipher.cell_bytes] = cipher.encrypt(self._ids[rows], data)
            at += len(data)
        return at


@dataclass(frozen=True)
class QuietReader(SaltedReader):
    """Reads the carriers of a stego model; equal Gaussians count once."""

    ids: Bytes  # [C, 16]
    low: Bytes  # [C, B]
    salts: Sequence[bytes]
    widths: Sequence[int]  # bytes of a carrier that parameters may take; empty without capacity
    blocks: bool = False  # the carriers are blocks of codes

    @staticmethod
    def of(stego: Gaussians) -> QuietReader | None:
        """The reader of the codes of a coded or decoded model, or None without capacity; else of low bits."""
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
        """None if `codes` have no capacity. `decoded`: the model that was decoded from them."""
        rows, ordered, fields = in_counted_order(codes, decoded.exact if decoded else None)
        low = read_blocks(last_bits(fields))
        if len(low) < MIN_BLOCKS:
            return None
        ids = block_ids(len(low), model_hash(ordered, decoded[rows].model if decoded else None))
        return QuietReader(ids[1:], low[1:], [salt(ids[0], low[0, :LEAST_BYTES])], [LEAST_BYTES], True)

    def extract(self, key: DerivedKey) -> Payload:
        """`open` after key derivation under one salt, without a warning.

        A wrong key makes the same passes over all cells, with a data key that matches nothing.
        """
        data_key, found, width, at = self._parameters(key)
        if (codewords := found.codewords) is None:
            return self._in_blocks(data_key, found, at)
        numbers, chunks = split_numbers(self._decrypt(chunk_cipher(data_key, width))[1])
        encrypted = codewords.decode(numbers, chunks)[: found.size]
        left = len(np.unique(numbers[numbers < codewords.chunks]))
        foreign = foreign_share(data_key, self.ids, found.sketch, found.gaussians)
        return Payload(
            found.method,
            decrypt(payload_key(data_key), encrypted, _ASSOCIATED),
            (left, codewords.chunks),
            foreign=math.ceil(foreign * len(self.ids)),
        )

    def _in_blocks(self, data_key: bytes, found: Parameters, at: int) -> Payload:
        """The payload in the blocks after block `at`, which holds its parameters."""
        count, width = -(-found.size // max(1, found.block_bytes)), found.block_bytes
        if count > len(self.low) or not 0 < width <= self.low.shape[1]:
            raise InputError("the hidden parameters are damaged: the data they describe exceed the file")
        rows = (at + 1 + np.arange(count)) % len(self.low)
        encrypted = self.low[rows, :width].tobytes()[: found.size]
        return Payload(found.method, decrypt(payload_key(data_key), encrypted, _ASSOCIATED))

    def _parameters(self, key: DerivedKey) -> tuple[bytes, Parameters, int, int]:
        """The data key, the parameters, the width of a carrier, and the last carrier of the parameters."""
        if not self.widths:
            raise WrongKeyError()
        votes = Counter(row.tobytes() for row in self._decrypt(key_cipher(key))[1]).most_common(1)
        data_key = votes[0][0] if votes else key.expand("quiet/none", DATA_KEY_BYTES)
        found = [self._decrypt(parameter_cipher(data_key, width)) for width in self.widths]
        for width, (fitting, parts) in zip(self.widths, found, strict=True):
            if len(parts):
                parameters = unpack(parts, None if self.blocks else width)
                return data_key, parameters, width, int(np.flatnonzero(fitting)[-1])
        # Without parameters, a key cell had a valid tag by chance (2^-32). Wrong keys read chunks as well.
        if not self.blocks:
            self._decrypt(chunk_cipher(data_key, max(self.widths)))
        raise WrongKeyError()

    def _decrypt(self, cipher: CellCipher) -> tuple[Flags, Bytes]:
        """Mask [C] of the carriers with a valid tag, and the data [M, size] of their cells in this order."""
        return cipher.decrypt(self.ids, self.low)


def payload_key(data_key: bytes) -> bytes:
    """The key that encrypts a payload, before it is cut into chunks."""
    return expand(data_key, "payload-key", 32)


def _unique_rows(ids: Bytes, low: Bytes) -> Integers:
    """Rows [M] that differ in `ids` [N, 16] or `low` bits [N, B]."""
    repeats = np.flatnonzero(repeated(ids.view("<u8")[:, 0]))
    if not len(repeats):
        return np.arange(len(ids))
    whole = np.concatenate([ids[repeats], low[repeats]], axis=1)
    _, first = np.unique(whole.view(f"S{whole.shape[1]}")[:, 0], return_index=True)
    return np.setdiff1d(np.arange(len(ids)), np.delete(repeats, first))
