"""Secrets in the low bits of a model, to be found again with nothing but the model and a key.

Nothing can be recognised: there is no magic number, no table, no order. A reader tries the cell of every
Gaussian and keeps those whose tag fits.

- The *salt* of Argon2id is a hash of one Gaussian that carries nothing else (see `salts`). Because it may be
  removed, there are SALTS of them. A salt whose Gaussian is not usable is *stale*: the author of the cover
  knows it in advance. There are key cells for the others. A reader tries SALTS_TRIED salts, and covers with
  as many stale ones are refused.
- *Key cells*, encrypted under the key and a salt, hold the secret's data key.
- *Parameter cells*, encrypted under the data key, tell how the rest is read (see `parameters`).
- *Records* are encrypted under the data key too; the numbered chunks of an encrypted payload are records (see
  `layout`). Other records need no number: shuffling and cropping are harmless, and a removed carrier takes
  only its own record with it. *Copies* of some have another label; they count where the record is gone.

All of it lies in random carriers (see `layout`), and every usable one gets new low bits, noise if nothing
else: cells of other secrets and of none look alike. All randomness comes from `entropy`, which must be
secret: if it followed from the cover and one secret, the holder of that secret's key could compute the file
without the others. No key stream is used twice: data keys depend on entropy and on all contents, and the key
stream of a cell on the data in it (see `cells`).
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from weakref import WeakKeyDictionary

import numpy as np
import torch
from torch import Tensor

from keyss.channels.base import SALTS_TRIED, Channel, Content, Room, check_keys, randomness
from keyss.channels.low_bits.bits import Layout, read_low_bits, write_low_bits
from keyss.channels.low_bits.contents import Writer, digest
from keyss.channels.low_bits.layout import LowBitsRoom
from keyss.channels.low_bits.salts import salt, salt_rows
from keyss.channels.low_bits.usable import check_usable, named_carriers
from keyss.core.arrays import Bytes, Flags, Integers
from keyss.core.errors import KeyssWarning, UsageError
from keyss.core.gaussians import Gaussians
from keyss.keys.derivation import DerivedKey, stream
from keyss.rendering.cpu.parallel import in_blocks

_FIRST_IS_STALE = (
    "the first salt of this model cannot be renewed: keys open it as usual, but not with `decoy=True`, which "
    "tries no other"
)


class LowBits(Channel):
    """The channel; see `keyss.channels.base.Channel`."""

    name = "low_bits"
    place = "low bits"
    records = True

    def __init__(self) -> None:
        # By cover, while it lives and does not change: (versions, usable, names, rows of salts).
        self._found: WeakKeyDictionary[Gaussians, tuple[list[int], Flags, Bytes, Integers]] = (
            WeakKeyDictionary()
        )

    def prepare(self, cover: Gaussians, *, sh_degree: int | None = None) -> LowBitsCover:
        """See `Channel`. Raises UsageError for low bits that are not random, and for stale salts.

        `sh_degree`: 1 if harmonics of higher degrees must stay as they are, to the bit.
        """
        layout, versions = Layout.of(cover), _versions(cover)
        if (found := self._found.get(cover)) is None or found[0] != versions:
            usable, names = named_carriers(cover, layout)
            check_usable(cover, usable, layout)
            rows = salt_rows(cover, names, layout=layout)
            stale = int((~usable[rows]).sum())
            if stale >= SALTS_TRIED:
                raise UsageError(
                    f"{stale} of the {len(rows)} salts of this cover cannot be renewed, and whoever made it "
                    "could try keys in advance"
                )
            found = self._found[cover] = versions, usable, names, rows
        if sh_degree is not None:
            layout = replace(layout, written_degree=min(sh_degree, layout.sh_degree))
        return LowBitsCover(cover, layout, *found[1:])

    def room(self, gaussians: int, sh_degree: int) -> Room:
        return LowBitsRoom.of(gaussians, sh_degree).for_payloads()


LOW_BITS = LowBits()


@dataclass(frozen=True)
class Embedded:
    """A stego model, and where in it everything lies."""

    gaussians: Gaussians
    places: list[tuple[Integers, Integers]]  # of each content: [R] the Gaussian and the cell of each record
    others: Integers  # [H] Gaussians of salts and headers

    def part(self, count: int) -> Integers:
        """About `count` Gaussians, or all, in their order: enough to open the content of their records."""
        spaced = np.arange(0, len(self.gaussians), max(1, len(self.gaussians) // count))
        return np.union1d(spaced, self.others)


@dataclass(frozen=True)
class LowBitsCover:
    """A cover and which of its Gaussians can be written; see `keyss.channels.base.PreparedCover`."""

    cover: Gaussians
    layout: Layout
    usable: Flags  # [N]
    names: Bytes  # [N, 16] identities
    salt_rows: Integers  # [S] in the order of salts

    @property
    def room(self) -> Room:
        return self.cells.for_payloads()

    @property
    def cells(self) -> LowBitsRoom:
        """The room for records."""
        return LowBitsRoom(len(self._rows), self.layout.width)

    def embed(self, contents: Sequence[tuple[str, Content]], *, entropy: bytes | None = None) -> Gaussians:
        """See `PreparedCover`. Takes 1.6 s for each secret for key derivation. Warns as `place` does."""
        return self.place(contents, entropy).gaussians

    def place(self, contents: Sequence[tuple[str, Content]], entropy: bytes | None) -> Embedded:
        """`embed`, with the places.

        Warns (KeyssWarning) if `decoy=True`, which tries the first salt alone, will not open the model.
        """
        mixed = randomness(entropy, *(digest(content) for _, content in contents))
        salts = self._salts(mixed)[1]
        if 0 not in self.fresh_salts:
            warnings.warn(_FIRST_IS_STALE, KeyssWarning, stacklevel=2)
        fresh = [salts[index] for index in self.fresh_salts]
        derived = [(_derived(key, fresh), content) for key, content in contents]
        return self.embed_derived(derived, mixed)

    def embed_derived(
        self, contents: Sequence[tuple[Sequence[DerivedKey], Content]], entropy: bytes
    ) -> Embedded:
        """`place` after key derivation: for each secret its key under each of the `fresh_salts`.

        `entropy`: of `randomness`, for no other file.
        """
        check_keys([keys[0].verifier() for keys, _ in contents])
        fresh, salts = self._salts(entropy)
        writer = Writer(self.names[self._rows], self.layout.width, entropy, bytes(each[0] for each in salts))
        writer.write(contents)
        rows = self._rows[writer.order]
        parts = [(self.salt_rows[self.fresh_salts], fresh), (rows, writer.table)]
        return Embedded(
            write_low_bits(self.cover, self.layout, parts),
            [(rows[own], slots) for _, (own, slots) in sorted(writer.places.items())],
            np.concatenate([self.salt_rows, rows[: writer.headers]]),
        )

    @cached_property
    def fresh_salts(self) -> Integers:
        """[F] the numbers of the salts whose Gaussians get new bits."""
        return np.flatnonzero(self.usable[self.salt_rows])

    @cached_property
    def _rows(self) -> Integers:
        """[C] the carriers."""
        carriers = self.usable.copy()
        carriers[self.salt_rows] = False
        return np.flatnonzero(carriers)

    def _salts(self, entropy: bytes) -> tuple[Bytes, list[bytes]]:
        """New low bits [F, B] of the Gaussians of fresh salts, and all salts with them."""
        noise = stream(entropy, "low-bits/salts", len(self.fresh_salts) * self.layout.width)
        fresh = np.frombuffer(noise, np.uint8).reshape(len(self.fresh_salts), self.layout.width)
        whole = replace(self.layout, written_degree=None)
        low = read_low_bits(self.cover[torch.from_numpy(self.salt_rows)], whole)
        low[self.fresh_salts, : self.layout.width] = fresh
        return fresh, [salt(*each) for each in zip(self.names[self.salt_rows], low, strict=True)]


def _versions(model: Gaussians) -> list[int]:
    """How often each tensor was changed in place."""
    tensors: list[Tensor] = [getattr(model, each.name) for each in fields(model)]
    return [0 if each.is_inference() else each._version for each in tensors]


def _derived(key: str, salts: Sequence[bytes]) -> list[DerivedKey]:
    """`key` under each salt, several at a time."""
    return in_blocks(lambda index, _: DerivedKey.of(key, salts[index]), len(salts), 1)
