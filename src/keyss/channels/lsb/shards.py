"""Shards and messages in slots with IDs, the low bits of Gaussians (docs/byte-layout.md).

Everything follows from a pseudo-random function of a secret and each Gaussian's ID, AES-256: Gaussians may
have any order, and nothing marks a carrier. No pad is used twice, because every secret here is new for every
file.

Each fragment of a *message* has several places. Some of these cannot be written, are taken or lost. A reader
looks at eight times as many, because others may have been added: the most frequent content counts.

*Shards* of a payload fill all Gaussians of a secret's share. One in 256 of the other Gaussians has the tag of
a shard by chance; rows of less than 5 bytes have none, and there one in 64 has a valid number. Such false
shards either contradict a true one, so that both are lost, or are errors, which the code corrects.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from keyss.channels.container import PARAMETER_BYTES
from keyss.channels.mixing import encrypted_blocks
from keyss.channels.reed_solomon import SYMBOL_BYTES, Codewords
from keyss.core.arrays import Bytes, Flags, Integers
from keyss.kernels.parallel import in_blocks
from keyss.keys.derivation import expand

_CANDIDATES = 8  # Gaussians considered for each place
_NUMBER_BYTES = 2
_LEAST_TAGGED = 5  # minimum bytes of a row with a tag
_PER_GROUP = 32  # codewords of a group whose rows have tags; groups of 2^15 shards hardly differ in size
_ROWS = 1 << 13  # rows per batch, whose temporaries fit in the cache
_BLOCK = 16


def function(secret: bytes, label: str, ids: Bytes, size: int = _BLOCK) -> Bytes:
    """[N, size] a pseudo-random function of `ids` [N, 16]; bytes 16 i to 16 i + 15 are AES of (ID xor i)."""
    key, blocks = _key(secret, label), -(-size // _BLOCK)
    output = np.empty((len(ids), size), np.uint8)

    def work(start: int, stop: int) -> None:
        counted = np.repeat(ids[start:stop, None], blocks, axis=1)
        counted[:, :, -1] ^= np.arange(blocks, dtype=np.uint8)
        output[start:stop] = encrypted_blocks(key, counted).reshape(stop - start, -1)[:, :size]

    in_blocks(work, len(ids), _ROWS)
    return output


def _key(secret: bytes, label: str) -> bytes:
    return expand(secret, f"lsb/{label}", 32)


def parameter_pads(data_key: bytes, ids: Bytes) -> Bytes:
    """[N, PARAMETER_BYTES] what encrypts parameters that slots with `ids` [N, 16] hold as a whole."""
    return function(data_key, "parameters/pad", ids, PARAMETER_BYTES)


@dataclass(frozen=True)
class Message:
    """A message of `size` bytes under a secret, in fragments of `width` bytes, each in `copies` places."""

    secret: bytes
    label: str
    size: int
    width: int
    copies: int

    @property
    def fragments(self) -> int:
        return -(-self.size // self.width)

    @property
    def places(self) -> int:
        """Gaussians that it takes."""
        return self.fragments * self.copies

    def write(self, ids: Bytes, data: bytes) -> tuple[Integers, Bytes]:
        """Rows of `ids` [N, 16], and the bytes [R, width] to be written into each."""
        every = np.frombuffer(data.ljust(self.fragments * self.width, b"\0"), np.uint8)
        places = [rows[: self.copies] for rows in self._candidates(ids)]
        rows = np.concatenate(places)
        pads = function(self.secret, f"{self.label}/pad", ids[rows], self.width)
        contents = np.repeat(every.reshape(-1, self.width), [len(rows) for rows in places], axis=0)
        return rows, contents ^ pads

    def read(self, ids: Bytes, low: Callable[[Integers], Bytes]) -> bytes:
        """The most frequent content of each fragment; `low`: the low bits [R, width or more] of rows [R]."""
        message = b""
        for rows in self._candidates(ids):
            pads = function(self.secret, f"{self.label}/pad", ids[rows], self.width)
            contents, times = np.unique(low(rows)[:, : self.width] ^ pads, axis=0, return_counts=True)
            message += contents[times.argmax()].tobytes() if len(rows) else bytes(self.width)
        return message[: self.size]

    def _candidates(self, ids: Bytes) -> Iterator[Integers]:
        """The rows that are looked at for each fragment, its places first."""
        key, count = _key(self.secret, f"{self.label}/place"), _CANDIDATES * self.places

        def least(start: int, stop: int) -> Integers:
            order = encrypted_blocks(key, ids[start:stop]).view(">u8")[:, 0].astype(np.uint64)
            return start + np.argpartition(order, min(count, len(order) - 1))[:count]

        near = np.concatenate(in_blocks(least, len(ids), _ROWS))
        values = encrypted_blocks(key, ids[near])
        order = values.view(">u8")[:, 0].argsort()[:count]
        fragment = values[order, 8:12].copy().view("<u4")[:, 0] % self.fragments
        for index in range(self.fragments):
            yield near[order[fragment == index]]


@dataclass(frozen=True)
class Shards:
    """The shards of a payload under its data key."""

    data_key: bytes
    codewords: Codewords
    tagged: bool

    @property
    def groups(self) -> int:
        return groups_of(self.codewords.count, self.tagged)

    @property
    def in_group(self) -> int:
        """Shards of a group."""
        return self.codewords.shards // self.groups

    def numbers(self, ids: Bytes) -> Integers | None:
        """[R] numbers of the shards that `ids` [R, 16] hold; all occur. None if a group is too small."""
        group = self._function(ids)[2]
        sizes = np.bincount(group, minlength=self.groups)
        if sizes.min() < self.in_group:
            return None
        order = group.astype(np.uint16).argsort(kind="stable")  # 16 bits take a tenth of the time
        place = np.arange(len(ids)) - np.repeat(sizes.cumsum() - sizes, sizes)
        groups = np.empty(len(ids), np.int64)
        groups[order] = self._number(group[order], place % self.in_group)
        return groups

    def encrypt(self, ids: Bytes, numbers: Integers, shards: Bytes) -> Bytes:
        """[R, ...] rows of shards [R, width] with `numbers` [R], in the groups of `ids` [R, 16]."""
        tags, masks, _ = self._function(ids)
        shard, codeword = np.divmod(numbers, self.codewords.count)
        local = shard * self._of_group + codeword % self._of_group
        masked = (masks ^ local.astype("<u2"))[:, None].view(np.uint8)
        data = function(self.data_key, "shard/pad", ids, self.codewords.width)
        data ^= shards
        return np.concatenate([tags[:, None][:, : self.tagged], masked, data], axis=1)

    def decrypt(self, ids: Bytes, low: Bytes) -> tuple[Flags, Integers, Bytes]:
        """Mask [N] of the rows that seem to hold shards; numbers [M] and data [M, width] of these."""
        tags, masks, group = self._function(ids)
        at = int(self.tagged)
        local = low[:, at : at + _NUMBER_BYTES].copy().view("<u2")[:, 0] ^ masks
        fits = local < self.in_group
        if self.tagged:
            fits &= low[:, 0] == tags
        rows, left = np.flatnonzero(fits), low[:, at + _NUMBER_BYTES :]
        data = function(self.data_key, "shard/pad", ids.take(rows, axis=0), self.codewords.width)
        for start in range(0, len(rows), _ROWS):  # a copy of all takes memory
            data[start : start + _ROWS] ^= left[rows[start : start + _ROWS], : self.codewords.width]
        return fits, self._number(group[fits], local[fits].astype(np.int64)), data

    @property
    def _of_group(self) -> int:
        """Codewords of a group."""
        return self.codewords.count // self.groups

    def _number(self, group: Integers, local: Integers) -> Integers:
        shard, codeword = np.divmod(local, self._of_group)
        return shard * self.codewords.count + group * self._of_group + codeword

    def _function(self, ids: Bytes) -> tuple[Bytes, Integers, Integers]:
        """[N] each: tags, masks of numbers, and groups."""
        values = function(self.data_key, "shard/place", ids)
        masks, groups = values[:, 2:4].copy().view("<u2")[:, 0], values[:, 4:8].copy().view("<u4")[:, 0]
        return values[:, 0], masks, groups.astype(np.int64) % self.groups


def is_tagged(width: int) -> bool:
    """True if rows of `width` bytes have a tag."""
    return width >= _LEAST_TAGGED


def shard_bytes(width: int) -> int:
    """Bytes of a shard in a row of `width` bytes; 0 if nothing fits."""
    return max(0, (width - _NUMBER_BYTES - is_tagged(width)) // SYMBOL_BYTES * SYMBOL_BYTES)


def groups_of(codewords: int, tagged: bool) -> int:
    """Groups of a number of `whole_groups`."""
    return max(1, codewords // (_PER_GROUP if tagged else 1))


def whole_groups(codewords: int, tagged: bool) -> int:
    """The least number of codewords from `codewords` on that can be divided into equal groups."""
    size = min(codewords, _PER_GROUP if tagged else 1)
    return -(-codewords // size) * size


def false_shards(foreign: int, groups: int, tagged: bool) -> float:
    """Expected number of false shards for each number, of `foreign` Gaussians."""
    return foreign / groups / (256.0 ** (_NUMBER_BYTES + tagged))
