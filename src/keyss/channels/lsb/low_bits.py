"""The channel in the low bits of floats.

IDs of Gaussians and a key tell where a secret lies (see `shards`), with redundancy: shuffling is harmless,
and a quarter of the Gaussians may be lost. A file has no magic number and no index of its secrets. Carriers,
the usable Gaussians, are chosen at random, and unused ones get noise, so the number of secrets does not show.

A *salt* of Argon2id is a hash of one Gaussian, which holds nothing else and gets new low bits in every file.
If that Gaussian is not usable (see `usable`), its bits stay, and the author of the cover can compute the salt
in advance: it is *stale*, and no key is written under it. A reader tries the first SALTS_TRIED salts of a
file and needs a fresh one among them. Covers with fewer than SALTS_TRIED stale salts among the first
2 SALTS_TRIED leave it one after random removal of a quarter, but for p < 3e-4; others are refused.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import count

import numpy as np
import torch

from keyss.channels import container
from keyss.channels.base import Capacity, Channel
from keyss.channels.container import Payload, SaltedReader
from keyss.channels.foreign import EXACT_BYTES, exact_foreign, exact_record
from keyss.channels.lsb.bits import DEEPEST, LEAST, Layout, gaussian_ids, read_low_bits, write_low_bits
from keyss.channels.lsb.low_bits_capacity import (
    DATA_KEY_BYTES,
    MAX_INDEPENDENT,
    Allocation,
    LowBitsCapacity,
    codewords_of,
    key_message,
    parameter_message,
)
from keyss.channels.lsb.salts import salt, salt_rows
from keyss.channels.lsb.shards import Shards, is_tagged, shard_bytes
from keyss.channels.lsb.usable import Carriers
from keyss.channels.mixing import random_order
from keyss.channels.reed_solomon import Codewords
from keyss.core.arrays import Bytes, Flags, Integers, repeated
from keyss.core.errors import UsageError, WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.kernels.parallel import in_blocks
from keyss.keys.derivation import MASTER_BYTES, DerivedKey, expand, fill, stream

Part = tuple[int, Integers, Bytes]  # a depth, rows of the model, and what is written into each


@dataclass(frozen=True)
class LowBitsCover:
    """A cover and its usable Gaussians; see `keyss.channels.base.PreparedCover`."""

    cover: Gaussians
    layout: Layout
    carriers: Carriers
    salt_rows: Integers  # [S] rows of the salts' Gaussians, in order

    @staticmethod
    def of(cover: Gaussians) -> LowBitsCover:
        """Raises UsageError for low bits that are few or not random, and for stale salts."""
        layout = Layout.of(cover)
        carriers = Carriers.of(cover, layout)
        rows = salt_rows(cover, carriers.ids, layout)
        first = rows[: 2 * container.SALTS_TRIED]
        stale = int((~carriers.renewable[first]).sum())
        if stale >= container.SALTS_TRIED:
            raise UsageError(
                f"{stale} of the first {len(first)} salts of this cover cannot be renewed, and whoever "
                "made it could try keys in advance"
            )
        return LowBitsCover(cover, layout, carriers, rows)

    @cached_property
    def capacity(self) -> Capacity:
        return self._capacity.for_payloads()

    def embed(self, payloads: Sequence[tuple[str, Payload]], *, entropy: bytes | None = None) -> Gaussians:
        """See `PreparedCover`. Takes 1.6 s for each secret for key derivation."""
        contents = [payload for _, payload in payloads]
        secret = container.randomness(entropy, contents, self.carriers.ids.tobytes())
        rows, width = self.salt_rows[self.carriers.renewable[self.salt_rows]], self.layout.width(LEAST)
        renewed = np.frombuffer(stream(secret, "lsb/salts", len(rows) * width), np.uint8).reshape(-1, width)
        salts = [salt(*carrier) for carrier in zip(self.carriers.ids[rows], renewed, strict=True)]
        keys = [_derive(key, salts) for key, _ in payloads]
        container.check_keys([derived[0].master for derived in keys])
        parts = [(LEAST, rows, renewed), *self._parts(keys, contents, secret)]
        return write_low_bits(self.cover, self.layout, parts)

    @cached_property
    def _usable(self) -> Flags:
        """[N] mask of usable Gaussians, without those of salts."""
        usable = self.carriers.usable.copy()
        usable[self.salt_rows] = False
        return usable

    @cached_property
    def _capacity(self) -> LowBitsCapacity:
        return LowBitsCapacity(len(self.cover), int(self._usable.sum()), self.layout, self.carriers.depth)

    def _parts(
        self, keys: Sequence[Sequence[DerivedKey]], payloads: Sequence[Payload], secret: bytes
    ) -> list[Part]:
        """What is to be written, in this order: noise, shards and headers.

        `keys`: of each payload, one under every fresh salt. `secret`: 32 bytes, all randomness of this file.
        """
        plan = self._capacity.plan([container.sealed_size(payload, EXACT_BYTES) for payload in payloads])
        if not plan.independent and len(payloads) > 1:
            container.warn_of_others()
        rows = np.flatnonzero(self._usable)
        noise = np.empty((len(rows), self.layout.width(plan.depth)), np.uint8)
        fill(secret, "lsb/noise", noise)
        for attempt in count():  # until no group of shards is too small
            free = self._usable.copy()
            headers, data_keys = self._headers(attempt, plan, keys, free, secret)
            left = np.flatnonzero(free)
            left = left[random_order(secret, f"lsb/shards/{attempt}", len(left))]
            bodies = list[Part]()
            for data_key, payload, share in zip(data_keys, payloads, plan.shares, strict=False):
                chosen, left = left[: share.carriers], left[share.carriers :]
                shards = Shards(data_key, share.codewords, is_tagged(noise.shape[1]))
                ids = self.carriers.ids.take(chosen, axis=0)
                if (numbers := shards.numbers(ids)) is None:
                    break
                record = exact_record(data_key, self.carriers.ids)
                sealed = container.seal(data_key, payload, share.codewords.size, record)
                contents = share.codewords.encode(sealed).take(numbers, axis=0)
                bodies.append((plan.depth, chosen, shards.encrypt(ids, numbers, contents)))
            else:
                return [(plan.depth, rows, noise), *headers, *bodies]
        raise AssertionError

    def _headers(
        self, attempt: int, plan: Allocation, keys: Sequence[Sequence[DerivedKey]], free: Flags, secret: bytes
    ) -> tuple[list[Part], list[bytes]]:
        """The headers of all payloads, and their data keys; their places are not `free` [N] any more.

        Missing headers take places, too: otherwise collisions would tell how many there are.
        """
        total = max(MAX_INDEPENDENT if plan.independent else 0, len(keys))
        data_keys = [
            expand(secret, f"lsb/data-key/{attempt}/{index}", DATA_KEY_BYTES) for index in range(total)
        ]
        width, parts = self.layout.width(LEAST), list[Part]()
        for index in random_order(secret, f"lsb/headers/{attempt}", total).tolist():
            salted: Sequence[DerivedKey] = [
                DerivedKey(expand(secret, f"lsb/no-key/{index}/{n}", MASTER_BYTES))
                for n in range(len(keys[0]))
            ]
            packed = b""
            if index < len(keys):
                salted, code = keys[index], plan.shares[index].codewords
                packed = container.Parameters(plan.depth, code.count, code.n, code.k).pack(data_keys[index])
            messages = [(parameter_message(data_keys[index], width), packed)]
            messages += [(key_message(container.key_secret(key), width), data_keys[index]) for key in salted]
            for message, data in messages:
                rows, contents = message.write(self.carriers.ids, data)
                if index < len(keys):
                    parts.append((LEAST, rows[free[rows]], contents[free[rows]]))
                free[rows] = False
        return parts, data_keys


def _estimated_capacity(gaussians: int, sh_degree: int) -> Capacity:
    return LowBitsCapacity.of(gaussians, Layout(sh_degree)).for_payloads()


LOW_BITS = Channel("low bits", LowBitsCover.of, _estimated_capacity)


@dataclass(frozen=True)
class LowBitsReader(SaltedReader):
    """Reads the low bits of a stego model; equal Gaussians count once."""

    stego: Gaussians
    ids: Bytes  # [N, 16]
    salts: Sequence[bytes]
    layout: Layout

    @staticmethod
    def of(stego: Gaussians) -> LowBitsReader:
        layout = Layout.of(stego)
        ids = gaussian_ids(stego, layout)
        rows = _unique_rows(stego, ids, layout)
        if len(rows) < len(ids):
            stego, ids = stego[torch.from_numpy(rows)], ids[rows]
        rows = salt_rows(stego, ids, layout)
        low = read_low_bits(stego[torch.from_numpy(rows)], LEAST, layout)
        salts = [salt(*carrier) for carrier in zip(ids[rows], low, strict=True)]
        return LowBitsReader(stego, ids, salts, layout)

    def extract(self, key: DerivedKey) -> Payload:
        """See `SaltedReader`. A wrong key makes all passes with a data key that matches nothing."""
        width = self.layout.width(LEAST)
        data_key = key_message(container.key_secret(key), width).read(self.ids, self._low)
        packed = parameter_message(data_key, width).read(self.ids, self._low)
        parameters = container.Parameters.unpack(packed, data_key)
        if parameters is None:
            none = Codewords(1, 1, 1, shard_bytes(self.layout.width(DEEPEST)))
            self._shards(data_key, none, DEEPEST)
            raise WrongKeyError()
        codewords = codewords_of(parameters, self.layout)
        numbers, shards = self._shards(data_key, codewords, parameters.depth)
        record, payload = container.unseal_shards(data_key, codewords, numbers, shards, EXACT_BYTES)
        return replace(
            payload,
            shards=(int((np.bincount(numbers) > 0).sum()), codewords.shards),
            foreign=exact_foreign(record, data_key, self.ids),
        )

    def _low(self, rows: Integers) -> Bytes:
        """[R, B] low bits at the least depth."""
        return read_low_bits(self.stego[torch.from_numpy(rows)], LEAST, self.layout)

    def _shards(self, data_key: bytes, codewords: Codewords, depth: int) -> tuple[Integers, Bytes]:
        """Numbers and data of all shards that seem to be there."""
        shards = Shards(data_key, codewords, is_tagged(self.layout.width(depth)))
        return shards.decrypt(self.ids, read_low_bits(self.stego, depth, self.layout))[1:]


def _unique_rows(stego: Gaussians, ids: Bytes, layout: Layout) -> Integers:
    """Rows [M] that differ in `ids` [N, 16] or low bits."""
    repeats = np.flatnonzero(repeated(ids.view("<u8")[:, 0]))
    if not len(repeats):
        return np.arange(len(ids))
    low = read_low_bits(stego[torch.from_numpy(repeats)], DEEPEST, layout)
    whole = np.concatenate([ids[repeats], low], axis=1)
    _, first = np.unique(whole.view(f"S{whole.shape[1]}")[:, 0], return_index=True)
    return np.setdiff1d(np.arange(len(ids)), np.delete(repeats, first))


def _derive(key: str, salts: Sequence[bytes]) -> list[DerivedKey]:
    """`key` under each salt, several at a time."""
    return in_blocks(lambda index, _: DerivedKey.of(key, salts[index]), len(salts), 1)
