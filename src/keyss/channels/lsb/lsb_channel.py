"""The LSB channel: secrets in low bits of floats, or in last bits of codes, a quantised format's integers.

A file has no magic number and no index of its secrets. Bits are stored in *carriers*: the low bits of one
Gaussian, or one block of last bits of codes (see `wet_paper`). A *salt* of Argon2id is a hash of one carrier
that holds nothing else. A salt is *stale* if its Gaussian is not usable (see `usable`): the author of the
cover knows it in advance, so no key is written under it. A reader tries SALTS_TRIED salts; covers with
as many stale ones among the first 2 SALTS_TRIED are refused: in others, random removal of a quarter leaves it
no fresh one with p < 3e-4.

In low bits, the IDs of Gaussians and a key tell where a secret lies (see `spread` and `lsb_header`), with
redundancy: shuffling is harmless, and a quarter of the Gaussians may be lost. In codes nothing may be lost or
reordered (see `blocks`).

Carriers are chosen at random, and unused usable carriers get noise, so the number of secrets does not show.
All randomness is derived from `entropy`, which must be secret: otherwise the holder of one key could compute
the file without the other secrets and compare. No key stream is used twice: data keys depend on entropy and
all payloads.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
import torch

from keyss.channels.base import SALTS_TRIED, Capacity, Channel, Payload, check_keys, randomness
from keyss.channels.lsb import wet_paper
from keyss.channels.lsb.bits import LEAST, Layout, read_low_bits, write_low_bits
from keyss.channels.lsb.blocks import HEADER_BLOCKS, LEAST_BYTES, MIN_BLOCKS, write_blocks
from keyss.channels.lsb.decoded import Decoded
from keyss.channels.lsb.fields import (
    FORMATS,
    Field,
    Levels,
    file_order,
    in_counted_order,
    in_rows,
    last_bits,
    model_hash,
    with_levels,
)
from keyss.channels.lsb.lsb_header import LowBitsCapacity
from keyss.channels.lsb.payloads import Writer
from keyss.channels.lsb.usable import Carriers, salt, salt_rows
from keyss.channels.lsb.writable_levels import fixed_axes, writable_levels
from keyss.channels.mixing import random_fractions
from keyss.core.arrays import Bits, Bytes, Flags, Integers
from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.files.formats.common import CodedGaussians, Codes
from keyss.kernels.parallel import in_blocks
from keyss.keys.derivation import DerivedKey, expand, stream
from keyss.keys.encryption import OVERHEAD

_ATTEMPTS = 30  # to solve all blocks; each fails for at most one cover in a thousand
_BITS_PER_GAUSSIAN = 18  # approximate capacity of codes


class LowBits(Channel):
    """The channel in the low bits of floats; see `keyss.channels.base.Channel`."""

    place = "low bits"

    def prepare(self, cover: Gaussians) -> LowBitsCover:
        """See `Channel`. Raises UsageError for low bits that are few or not random, and for stale salts."""
        layout = Layout.of(cover)
        carriers = Carriers.of(cover, layout)
        rows = salt_rows(cover, carriers.ids, layout)
        first = rows[: 2 * SALTS_TRIED]
        stale = int((~carriers.renewable[first]).sum())
        if stale >= SALTS_TRIED:
            raise UsageError(
                f"{stale} of the first {len(first)} salts of this cover cannot be renewed, and whoever "
                "made it could try keys in advance"
            )
        return LowBitsCover(cover, layout, carriers, rows)

    def estimate_capacity(self, gaussians: int, sh_degree: int) -> Capacity:
        return LowBitsCapacity.of(gaussians, Layout(sh_degree)).for_payloads()


LOW_BITS = LowBits()


class InCodes(Channel):
    """The channel in the codes of `format`, `spz`, `sog` or `compressed-ply`.

    The file of these codes is published, or a model that was `decoded` from them.
    """

    def __init__(self, format: str, decoded: Decoded | None = None) -> None:
        self.format, self.decoded = format, decoded
        self.place = f"{format} codes"
        if decoded:
            self.place = f"{format} codes that its numbers were decoded from"

    def prepare(self, cover: Gaussians) -> CodesCover:
        """See `Channel`. A model that was read from a file of this format keeps its codes.

        With `decoded`, the cover is its model, perhaps with fewer harmonics.
        """
        if self.decoded is None:
            return CodesCover.of(FORMATS[self.format].of(cover))
        return CodesCover.of(self.decoded.codes, replace(self.decoded, model=cover.detach().to("cpu")))

    def estimate_capacity(self, gaussians: int, sh_degree: int) -> Capacity:
        return Capacity(gaussians * _BITS_PER_GAUSSIAN // 8, _overhead(wet_paper.BLOCK // 8))


@dataclass(frozen=True)
class LowBitsCover:
    """A cover and its usable Gaussians; see `keyss.channels.base.PreparedCover`."""

    cover: Gaussians
    layout: Layout
    carriers: Carriers
    salt_rows: Integers  # [S] rows of the salts' Gaussians, in order

    @cached_property
    def capacity(self) -> Capacity:
        return self._capacity.for_payloads()

    def embed(self, payloads: Sequence[tuple[str, Payload]], *, entropy: bytes | None = None) -> Gaussians:
        """See `PreparedCover`. Takes 1.6 s for each secret for key derivation."""
        mixed = randomness(entropy, self.carriers.ids.tobytes(), *(payload.data for _, payload in payloads))
        salts = self._salts(mixed)[1]
        fresh = [salts[index] for index in self.fresh_salts]
        return self.embed_derived([(_derive(key, fresh), payload) for key, payload in payloads], mixed)

    def embed_derived(
        self, payloads: Sequence[tuple[Sequence[DerivedKey], Payload]], entropy: bytes
    ) -> Gaussians:
        """`embed` after key derivation: each secret comes with its key under each of the `fresh_salts`.

        `entropy`: the result of `randomness`, used for this file only.
        """
        check_keys([keys[0].verifier() for keys, _ in payloads])
        parts = [(LEAST, self.salt_rows[self.fresh_salts], self._salts(entropy)[0])]
        parts += Writer(self._capacity, self._usable, self.carriers.ids, entropy).write(payloads)
        return write_low_bits(self.cover, self.layout, parts)

    @cached_property
    def fresh_salts(self) -> Integers:
        """[F] indices of the salts that are not stale."""
        return np.flatnonzero(self.carriers.renewable[self.salt_rows])

    @cached_property
    def _usable(self) -> dict[int, Flags]:
        """[N] masks, by depth, without the Gaussians of salts."""
        others = np.ones(len(self.cover), bool)
        others[self.salt_rows] = False
        return {depth: usable & others for depth, usable in self.carriers.usable.items()}

    @cached_property
    def _capacity(self) -> LowBitsCapacity:
        counts = {depth: int(usable.sum()) for depth, usable in self._usable.items()}
        return LowBitsCapacity(len(self.cover), counts, self.layout)

    def _salts(self, entropy: bytes) -> tuple[Bytes, list[bytes]]:
        """New low bits [F, B] of the Gaussians of fresh salts, and all salts with these low bits."""
        width = self.layout.width(LEAST)
        noise = stream(entropy, "lsb/salts", len(self.fresh_salts) * width)
        fresh = np.frombuffer(noise, np.uint8).reshape(len(self.fresh_salts), width)
        rows = self.cover[torch.from_numpy(self.salt_rows)]
        renewed = write_low_bits(rows, self.layout, [(LEAST, self.fresh_salts, fresh)])
        low = read_low_bits(renewed, LEAST, self.layout)
        ids = self.carriers.ids[self.salt_rows]
        return fresh, [salt(*each) for each in zip(ids, low, strict=True)]


@dataclass(frozen=True)
class CodesCover:
    """Codes and their writable levels; see `keyss.channels.base.PreparedCover`."""

    codes: Codes  # in the order in which bits are counted
    fields: list[Field]
    free: list[Flags]  # [N] per field: levels that may be written
    model_hash: bytes
    decoded: Decoded | None = None  # in the same order; its model is published instead of the codes

    @staticmethod
    def of(codes: Codes, decoded: Decoded | None = None) -> CodesCover:
        """`decoded`: its model is published instead of the codes. Raises UsageError for no capacity."""
        rows, ordered, own = in_counted_order(codes, decoded.exact if decoded else None)
        model = decoded[rows] if decoded else None
        own_hash = model_hash(ordered, model.model if model else None)
        free = writable_levels(ordered, own, fixed_axes(codes), _digest(codes))
        cover = CodesCover(ordered, own, free, own_hash, model)
        if len(cover.ids) < MIN_BLOCKS or cover.width < LEAST_BYTES:
            why = "it has too few Gaussians"
            if len(cover.ids) >= MIN_BLOCKS:
                why = (
                    f"{cover.dry.mean():.0%} of the last bits can change unnoticed, and each block of "
                    f"{wet_paper.BLOCK:,} needs {8 * LEAST_BYTES} such bits"
                )
            raise UsageError(
                f"a cover of {len(codes):,} Gaussians has no room for secrets in the codes of {codes.name} "
                f"files: {why}"
            )
        return cover

    @cached_property
    def dry(self) -> Bits:
        """1 for last bits that may be written."""
        parts = [np.repeat(free, each.bits) for free, each in zip(self.free, self.fields, strict=True)]
        return np.concatenate(parts).astype(np.uint8)

    @cached_property
    def places(self) -> Integers:
        """Indices of the blocks' bits; see `wet_paper.places`."""
        return wet_paper.places(len(self.dry))

    @cached_property
    def width(self) -> int:
        """Bytes per block."""
        return wet_paper.width_of(self.dry[self.places])

    @property
    def ids(self) -> Bytes:
        """[C, 16] IDs of the blocks; the first block is the salt."""
        return wet_paper.block_ids(len(self.places) // wet_paper.BLOCK, self.model_hash)

    @cached_property
    def capacity(self) -> Capacity:
        size = (len(self.ids) - 1) * self.width
        return Capacity(size, _overhead(self.width))

    @property
    def cover(self) -> Gaussians:
        return self.decoded.model if self.decoded else CodedGaussians.of(self.codes)

    def embed(self, payloads: Sequence[tuple[str, Payload]], *, entropy: bytes | None = None) -> Gaussians:
        """See `PreparedCover`."""
        mixed = randomness(entropy, _digest(self.codes), *(payload.data for _, payload in payloads))
        for attempt in range(_ATTEMPTS):
            own = expand(mixed, f"lsb/attempt/{attempt}", 32)
            first = np.frombuffer(stream(own, "lsb/salts", self.width), np.uint8)
            salts = [salt(self.ids[0], first[:LEAST_BYTES])]
            derived = [(_derive(key, salts), payload) for key, payload in payloads]
            check_keys([keys[0].verifier() for keys, _ in derived])
            table = write_blocks(self.ids[1:], self.width, own, [(keys[0], each) for keys, each in derived])
            if (bits := self._solve(np.concatenate([first[None], table]), own)) is not None:
                return self._model_to_publish(self._with_bits(bits, own), own)
        raise RuntimeError("the blocks of this cover cannot be solved")

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
        """The codes with new last `bits` of all levels."""
        columns: dict[str, list[Levels]] = {}
        parts = np.split(bits, np.cumsum([each.total_bits for each in self.fields])[:-1])
        for field, free, own in zip(self.fields, self.free, parts, strict=True):
            ties = random_fractions(entropy, f"codes/ties/{field.name}/{field.column}", len(free)) - 0.5
            levels = np.where(free, field.with_bits(own, ties), field.levels)
            columns.setdefault(field.name, []).append(levels)
        attributes = {name: np.stack(each, axis=1) for name, each in columns.items()}
        codes: Codes = with_levels(self.codes, attributes)
        return codes

    def _model_to_publish(self, codes: Codes, entropy: bytes) -> Gaussians:
        """The model of `codes` in the order of the format or, if the cover has an own one, of the cover."""
        within = random_fractions(entropy, "codes/file-order", 3 * len(codes)).reshape(-1, 3) - 0.5
        order = file_order(codes, within)
        if self.decoded is None:
            return CodedGaussians.of(in_rows(codes, order))
        if not self.decoded.is_sorted:
            order = self.decoded.order.argsort()
        return self.decoded.with_codes(self.codes, codes)[torch.from_numpy(order)]


def _overhead(width: int) -> int:
    """Maximum bytes of a payload beside its data, in blocks of `width` bytes."""
    return (HEADER_BLOCKS + 1) * width + OVERHEAD


def _derive(key: str, salts: Sequence[bytes]) -> list[DerivedKey]:
    """`key` under each salt, several at a time."""
    return in_blocks(lambda index, _: DerivedKey.of(key, salts[index]), len(salts), 1)


def _digest(codes: Codes) -> bytes:
    state = hashlib.sha256()
    for each in fields(codes):  # type: ignore[arg-type]
        value = getattr(codes, each.name)
        state.update(value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode())
    return state.digest()
