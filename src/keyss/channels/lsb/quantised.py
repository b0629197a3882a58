"""The channel in the quantised values of a `.spz`, `.sog` or compressed `.ply`, or of a decoded model.

The slots are blocks of last bits (see `wet_paper`), which are never lost or reordered. A secret takes
consecutive blocks, cyclically. Other blocks hold noise, so the number of secrets does not show, and all
arrangements are equally likely.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
import torch

from keyss.channels import container
from keyss.channels.base import Capacity, Channel
from keyss.channels.container import Payload, SaltedReader
from keyss.channels.lsb import wet_paper
from keyss.channels.lsb.decoded import Decoded
from keyss.channels.lsb.fields import (
    QUANTISED,
    Field,
    Levels,
    file_order,
    in_counted_order,
    in_rows,
    last_bits,
    model_hash,
    with_levels,
)
from keyss.channels.lsb.salts import salt
from keyss.channels.lsb.shards import parameter_pads
from keyss.channels.lsb.writable_levels import fixed_axes, writable_levels
from keyss.channels.mixing import random_fractions, random_order, random_words
from keyss.core.arrays import Bits, Bytes, Flags, Integers
from keyss.core.errors import InputError, UsageError, WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.files.formats.common import CodedGaussians, Codes
from keyss.keys.derivation import DerivedKey, expand, fill, stream

LEAST_BYTES = 48  # minimum bytes of a block, which give the salt
MIN_BLOCKS = 3  # a salt, parameters, and data
_ATTEMPTS = 30  # attempts to solve all blocks; one fails for at most one cover in a thousand
_BITS_PER_GAUSSIAN = 18  # approximate capacity


def quantised_channel(format: str, decoded: Decoded | None = None) -> Channel:
    """The channel in the quantised values of `format`, `spz`, `sog` or `compressed-ply`.

    Their file is published, and a model that was read from such a file keeps its values. With `decoded`, its
    model is published, and the cover is this model, perhaps with fewer harmonics.
    """

    def prepare(cover: Gaussians) -> QuantisedCover:
        if decoded is None:
            return QuantisedCover.of(QUANTISED[format].of(cover))
        return QuantisedCover.of(decoded.codes, replace(decoded, model=cover.detach().to("cpu")))

    def estimate(gaussians: int, sh_degree: int) -> Capacity:
        return _capacity(gaussians * _BITS_PER_GAUSSIAN // 8, wet_paper.BLOCK // 8)

    place = f"quantised values of {format}"
    if decoded:
        place = f"values of the {format} file that the cover was decoded from"
    return Channel(place, prepare, estimate)


@dataclass(frozen=True)
class QuantisedCover:
    """Quantised values, and which of them may be written; see `keyss.channels.base.PreparedCover`."""

    codes: Codes  # in the order in which bits are counted
    fields: list[Field]
    free: list[Flags]  # [N] per field: levels that may be written
    model_hash: bytes
    decoded: Decoded | None = None  # in the order of `codes`; its model is published instead of the file

    @staticmethod
    def of(codes: Codes, decoded: Decoded | None = None) -> QuantisedCover:
        """`decoded`: its model is published instead of the file. Raises UsageError for no capacity."""
        rows, ordered, places = in_counted_order(codes, decoded.exact if decoded else None)
        model = decoded[rows] if decoded else None
        own_hash = model_hash(ordered, model.model if model else None)
        free = writable_levels(ordered, places, fixed_axes(codes), _digest(codes))
        cover = QuantisedCover(ordered, places, free, own_hash, model)
        if len(cover.ids) < MIN_BLOCKS or cover.width < LEAST_BYTES:
            raise UsageError(
                f"a cover of {len(codes):,} Gaussians has no room for secrets in the quantised values of "
                f"{codes.name} files: {int(cover.dry.sum()):,} last bits can change unnoticed"
            )
        return cover

    @cached_property
    def dry(self) -> Bits:
        """1 for last bits that may be written."""
        parts = [np.repeat(free, field.bits) for free, field in zip(self.free, self.fields, strict=True)]
        return np.concatenate(parts).astype(np.uint8)

    @cached_property
    def places(self) -> Integers:
        """Indices of the blocks' bits; see `wet_paper.places`."""
        return wet_paper.places(len(self.dry))

    @cached_property
    def width(self) -> int:
        """Bytes per block."""
        return wet_paper.width_of(self.dry[self.places])

    @cached_property
    def ids(self) -> Bytes:
        """[C, 16] IDs of the blocks; the first block is the salt."""
        return wet_paper.block_ids(len(self.places) // wet_paper.BLOCK, self.model_hash)

    @cached_property
    def capacity(self) -> Capacity:
        return _capacity((len(self.ids) - 1) * self.width, self.width)

    @property
    def cover(self) -> Gaussians:
        return self.decoded.model if self.decoded else CodedGaussians.of(self.codes)

    def embed(self, payloads: Sequence[tuple[str, Payload]], *, entropy: bytes | None = None) -> Gaussians:
        """See `PreparedCover`."""
        contents = [payload for _, payload in payloads]
        mixed = container.randomness(entropy, contents, _digest(self.codes))
        for attempt in range(_ATTEMPTS):
            seed = expand(mixed, f"lsb/attempt/{attempt}", 32)
            table = np.empty((len(self.ids), self.width), np.uint8)
            fill(seed, "lsb/noise", table)
            first = salt(self.ids[0], table[0, :LEAST_BYTES])
            keys = [container.key_secret(DerivedKey.of(key, first)) for key, _ in payloads]
            container.check_keys(keys)
            self._write(table, seed, keys, contents)
            if (bits := self._solve(table, seed)) is not None:
                return self._model_to_publish(self._with_bits(bits, seed), seed)
        raise RuntimeError("the blocks of this cover cannot be solved")

    def _write(
        self, table: Bytes, entropy: bytes, data_keys: Sequence[bytes], payloads: Sequence[Payload]
    ) -> None:
        """Write payloads, each under its data key, into the blocks [C, width] of `table`."""
        ids, blocks = self.ids[1:], table[1:]
        counts = [-(-container.sealed_size(payload) // self.width) for payload in payloads]
        if (free := len(blocks) - sum(counts) - len(counts)) < 0:
            raise UsageError(
                f"the secrets take {self.width * (len(blocks) - free):,} bytes, and this cover has room for "
                f"{blocks.size:,}"
            )
        first, *gaps = random_words(entropy, "lsb/gaps", len(payloads) + 1).tolist()
        gaps = sorted(gap % (free + 1) for gap in gaps)
        for index in random_order(entropy, "lsb/along", len(payloads)).tolist():
            data_key, count = data_keys[index], counts[index]
            rows = ((first + gaps.pop(0)) % len(blocks) + np.arange(count + 1)) % len(blocks)
            packed = container.Parameters(self.width, count).pack(data_key)
            pads = parameter_pads(data_key, ids[rows[:1]])
            blocks[rows[0], : len(packed)] = np.frombuffer(packed, np.uint8) ^ pads[0]
            sealed = container.seal(data_key, payloads[index], count * self.width)
            blocks[rows[1:]] = np.frombuffer(sealed, np.uint8).reshape(-1, self.width)
            first += count + 1

    def _solve(self, table: Bytes, entropy: bytes) -> Bits | None:
        """The last bits of all levels, so that blocks hold `table` [C, width]; free bits are random.

        None if a block has no solution.
        """
        noise = np.frombuffer(stream(entropy, "codes/free", -(-len(self.dry) // 8)), np.uint8)
        bits = np.where(self.dry, np.unpackbits(noise)[: len(self.dry)], last_bits(self.fields))
        messages = np.unpackbits(table, axis=1, bitorder="little")
        solved = wet_paper.write(bits[self.places], self.dry[self.places], messages)
        if solved is None:
            return None
        bits[self.places] = solved
        return bits

    def _with_bits(self, bits: Bits, entropy: bytes) -> Codes:
        """The quantised values with new last `bits` of all levels."""
        columns: dict[str, list[Levels]] = {}
        parts = np.split(bits, np.cumsum([field.bits.sum() for field in self.fields])[:-1])
        for field, free, field_bits in zip(self.fields, self.free, parts, strict=True):
            ties = random_fractions(entropy, f"codes/ties/{field.name}/{field.column}", len(free)) - 0.5
            levels = np.where(free, field.with_bits(field_bits, ties), field.levels)
            columns.setdefault(field.name, []).append(levels)
        attributes = {name: np.stack(column, axis=1) for name, column in columns.items()}
        codes: Codes = with_levels(self.codes, attributes)
        return codes

    def _model_to_publish(self, codes: Codes, entropy: bytes) -> Gaussians:
        """The model of `codes` in the order of the format or, if the cover has its own, of the cover."""
        within = random_fractions(entropy, "codes/file-order", 3 * len(codes)).reshape(-1, 3) - 0.5
        order = file_order(codes, within)
        if self.decoded is None:
            return CodedGaussians.of(in_rows(codes, order))
        if not self.decoded.is_sorted:
            order = self.decoded.order.argsort()
        return self.decoded.with_codes(self.codes, codes)[torch.from_numpy(order)]


@dataclass(frozen=True)
class QuantisedReader(SaltedReader):
    """Reads the quantised values of a stego model."""

    ids: Bytes  # [C, 16]
    blocks: Bytes  # [C, B]
    salts: Sequence[bytes]

    @staticmethod
    def of(codes: Codes, decoded: Decoded | None = None) -> QuantisedReader | None:
        """None without capacity. `decoded`: the model that was decoded from `codes`."""
        rows, ordered, fields = in_counted_order(codes, decoded.exact if decoded else None)
        blocks = wet_paper.read_blocks(last_bits(fields))
        if len(blocks) < MIN_BLOCKS:
            return None
        own_hash = model_hash(ordered, decoded[rows].model if decoded else None)
        ids = wet_paper.block_ids(len(blocks), own_hash)
        return QuantisedReader(ids[1:], blocks[1:], [salt(ids[0], blocks[0, :LEAST_BYTES])])

    def extract(self, key: DerivedKey) -> Payload:
        """See `SaltedReader`."""
        data_key = container.key_secret(key)
        opened = self.blocks[:, : container.PARAMETER_BYTES] ^ parameter_pads(data_key, self.ids)
        check = np.frombuffer(container.check_of(data_key), np.uint8)
        rows = np.flatnonzero((opened[:, : len(check)] == check).all(axis=1))
        parameters = container.Parameters.unpack(opened[rows[0]].tobytes(), data_key) if len(rows) else None
        if parameters is None:
            raise WrongKeyError()
        width, count = parameters.depth, parameters.count
        if not 0 < count < len(self.blocks) or not 0 < width <= self.blocks.shape[1]:
            raise InputError("the hidden parameters are damaged: the data they describe exceed the file")
        rows = (rows[0] + 1 + np.arange(count)) % len(self.blocks)
        return container.unseal(data_key, self.blocks[rows, :width].tobytes())[1]


def _capacity(total: int, width: int) -> Capacity:
    """The capacity of `total` bytes in blocks of `width`: one holds parameters; the last may not be full."""
    shares = [(1 / part, total // part) for part in (4, 2, 1)]
    return Capacity.of_sealed(2 * width + container.MAX_OVERHEAD, shares, lambda count: total // count)


def _digest(codes: Codes) -> bytes:
    state = hashlib.sha256()
    for attribute in fields(codes):  # type: ignore[arg-type]
        value = getattr(codes, attribute.name)
        state.update(value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode())
    return state.digest()
