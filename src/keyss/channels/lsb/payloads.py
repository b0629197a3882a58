"""Payloads in low bits: written with noise everywhere else, and read with a key."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import count

import numpy as np
import torch

from keyss.channels.base import NOT_INDEPENDENT, Payload, SaltedReader
from keyss.channels.lsb.bits import DEEPEST, LEAST, Layout, gaussian_ids, read_low_bits
from keyss.channels.lsb.blocks import ASSOCIATED, BlockReader
from keyss.channels.lsb.decoded import Decoded
from keyss.channels.lsb.lsb_header import (
    DATA_KEY_BYTES,
    MAX_INDEPENDENT,
    LowBitsCapacity,
    Parameters,
    key_message,
    key_secret,
    parameter_message,
)
from keyss.channels.lsb.spread import Shards, is_tagged, shard_bytes
from keyss.channels.lsb.usable import repeated, salt, salt_rows
from keyss.channels.mixing import bloom_filter, foreign_share, random_order
from keyss.channels.reed_solomon import Codewords
from keyss.core.arrays import Bytes, Flags, Integers
from keyss.core.errors import InputError, KeyssWarning, WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.files.formats.common import CodedGaussians
from keyss.keys.derivation import MASTER_BYTES, DerivedKey, expand, fill
from keyss.keys.encryption import OVERHEAD, compressed_size, decrypt, encrypt

Part = tuple[int, Integers, Bytes]  # a depth, rows of the model, and what is written into each


@dataclass(frozen=True)
class Writer:
    """Writes payloads into the `usable` [N] Gaussians, by depth, of a model with `ids` [N, 16].

    `entropy`: 32 secret bytes.
    """

    capacity: LowBitsCapacity
    usable: Mapping[int, Flags]
    ids: Bytes
    entropy: bytes

    def write(self, payloads: Sequence[tuple[Sequence[DerivedKey], Payload]]) -> list[Part]:
        """What is to be written, in this order: noise, shards and headers.

        Each payload comes with its key under every salt that is not stale. Raises UsageError for too large
        payloads. Warns (KeyssWarning) if the holder of one key can tell that there are other secrets.
        """
        sizes = [compressed_size(payload.data) + OVERHEAD for _, payload in payloads]
        plan, layout = self.capacity.plan(sizes), self.capacity.layout
        if not plan.independent and len(payloads) > 1:
            warnings.warn(NOT_INDEPENDENT, KeyssWarning, stacklevel=4)
        rows = np.flatnonzero(self.usable[plan.depth])
        noise = np.empty((len(rows), layout.width(plan.depth)), np.uint8)
        fill(self.entropy, "lsb/noise", noise)
        tagged = is_tagged(noise.shape[1])
        for attempt in count():  # until no group of shards is too small
            free, parts = self.usable[plan.depth].copy(), [(plan.depth, rows, noise)]
            # Missing headers take places, too: otherwise collisions would tell how many there are.
            headers = max(MAX_INDEPENDENT if plan.independent else 0, len(payloads))
            data_keys = [
                self._secret(f"data-key/{attempt}/{each}", DATA_KEY_BYTES) for each in range(headers)
            ]
            for index in random_order(self.entropy, f"lsb/headers/{attempt}", headers).tolist():
                data_key = data_keys[index]
                if index >= len(payloads):
                    keys = [
                        DerivedKey(self._secret(f"no-key/{index}/{n}")) for n in range(len(payloads[0][0]))
                    ]
                    self._header(free, data_key, keys, b"")
                    continue
                (keys, payload), share = payloads[index], plan.shares[index]
                bloom = bloom_filter(data_key, self.ids)
                fields = sizes[index], plan.depth, len(self.ids), share.codewords, bloom
                packed = Parameters(payload.method, *fields).pack(data_key)
                parts += self._header(free, data_key, keys, packed)
            left = np.flatnonzero(free)
            left = left[random_order(self.entropy, f"lsb/shards/{attempt}", len(left))]
            for data_key, (_, payload), share, size in zip(
                data_keys, payloads, plan.shares, sizes, strict=False
            ):
                own, left = left[: share.carriers], left[share.carriers :]
                shards = Shards(data_key, share.codewords, tagged)
                if (numbers := shards.numbers(self.ids[own])) is None:
                    break
                data = encrypt(expand(data_key, "payload-key", 32), payload.data, ASSOCIATED, size=size)
                contents = share.codewords.encode(data)[numbers]
                parts.append((plan.depth, own, shards.encrypt(self.ids[own], numbers, contents)))
            else:
                return parts
        raise AssertionError

    def _header(
        self, free: Flags, data_key: bytes, keys: Sequence[DerivedKey], parameters: bytes
    ) -> list[Part]:
        """The messages of a header in their places that are `free` [N], which are so no longer."""
        width, parts = self.capacity.layout.width(LEAST), []
        messages = [(parameter_message(data_key, width), parameters)]
        messages += [(key_message(key_secret(key), width), data_key) for key in keys]
        for message, data in messages:
            rows, contents = message.write(self.ids, data)
            own = free[rows]
            free[rows] = False
            parts.append((LEAST, rows[own], contents[own]))
        return parts

    def _secret(self, label: str, size: int = MASTER_BYTES) -> bytes:
        return expand(self.entropy, f"lsb/{label}", size)


@dataclass(frozen=True)
class LsbReader(SaltedReader):
    """Reads the low bits of a stego model; equal Gaussians count once."""

    stego: Gaussians
    ids: Bytes  # [N, 16]
    low: Bytes  # [N, B] at the least depth
    salts: Sequence[bytes]
    layout: Layout

    @staticmethod
    def of(stego: Gaussians) -> LsbReader | BlockReader | None:
        """The reader of the codes of a coded or decoded model, or None without capacity; else of low bits."""
        if isinstance(stego, CodedGaussians):
            return BlockReader.of(stego.codes)
        if decoded := Decoded.of(stego):
            return BlockReader.of(decoded.codes, decoded)
        layout = Layout.of(stego)
        ids, low = gaussian_ids(stego, layout), read_low_bits(stego, LEAST, layout)
        rows = _unique_rows(stego, ids, layout)
        if len(rows) < len(ids):
            stego, ids, low = stego[torch.from_numpy(rows)], ids[rows], low[rows]
        salts = [salt(ids[row], low[row]) for row in salt_rows(stego, ids, layout)]
        return LsbReader(stego, ids, low, salts, layout)

    def extract(self, key: DerivedKey) -> Payload:
        """`open` after key derivation under one salt, without a warning.

        A wrong key makes the same passes over all Gaussians, with a data key that matches nothing.
        """
        width = self.layout.width(LEAST)
        data_key = key_message(key_secret(key), width).read(self.ids, self.low)
        packed = parameter_message(data_key, width).read(self.ids, self.low)
        if found := Parameters.unpack(packed, data_key, self.layout):
            return self._payload(data_key, found)
        width = self.layout.width(DEEPEST)
        none = Codewords(1, 1, 1, shard_bytes(width))
        self._shards(Shards(data_key, none, is_tagged(width)), DEEPEST)
        raise WrongKeyError()

    def _payload(self, data_key: bytes, found: Parameters) -> Payload:
        _, numbers, shards = self._shards(found.shards(data_key, self.layout), found.depth)
        left = len(np.unique(numbers))
        foreign = foreign_share(data_key, self.ids, found.bloom, found.gaussians)
        return Payload(
            found.method,
            self._decrypted(data_key, found, numbers, shards),
            (left, found.codewords.shards),
            foreign=math.ceil(foreign * len(self.ids)),
        )

    def _shards(self, shards: Shards, depth: int) -> tuple[Flags, Integers, Bytes]:
        return shards.decrypt(self.ids, read_low_bits(self.stego, depth, self.layout))

    def _decrypted(self, data_key: bytes, found: Parameters, numbers: Integers, shards: Bytes) -> bytes:
        """The data of a payload; looks for false shards only if its authentication fails."""
        payload_key = expand(data_key, "payload-key", 32)
        with suppress(InputError):
            encrypted = found.codewords.decode(numbers, shards)
            return decrypt(payload_key, encrypted[: found.size], ASSOCIATED)
        encrypted = found.codewords.decode(numbers, shards, errors=True)
        return decrypt(payload_key, encrypted[: found.size], ASSOCIATED)


def _unique_rows(stego: Gaussians, ids: Bytes, layout: Layout) -> Integers:
    """Rows [M] that differ in `ids` [N, 16] or low bits."""
    repeats = np.flatnonzero(repeated(ids.view("<u8")[:, 0]))
    if not len(repeats):
        return np.arange(len(ids))
    low = read_low_bits(stego[torch.from_numpy(repeats)], DEEPEST, layout)
    whole = np.concatenate([ids[repeats], low], axis=1)
    _, first = np.unique(whole.view(f"S{whole.shape[1]}")[:, 0], return_index=True)
    return np.setdiff1d(np.arange(len(ids)), np.delete(repeats, first))
