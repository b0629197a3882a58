"""Payloads in colours: they survive formats that round, and changes of order and frame.

A payload is encrypted and authenticated (ChaCha20-Poly1305), made into code bits (`fountain`), and written
into colours (`lattice`) of Gaussians that are identified by their other numbers (`carriers`). A *header*
under a few *salts* tells how it is read; see `header` and `carriers`. Nothing in the model tells how many
secrets there are, or that there are any.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch

from keyss.channels.base import (
    METHOD_BYTES,
    NOTICED,
    Channel,
    Content,
    Room,
    check_keys,
    pack_payload,
    randomness,
)
from keyss.channels.colours.capacity import Capacity, Layout, bucket_of
from keyss.channels.colours.carriers import SALTS, Numbers, Salts, renewed, steady
from keyss.channels.colours.fountain import Fountain
from keyss.channels.colours.header import (
    FILE_KEY_BYTES,
    IDLE,
    SHARES,
    UNNOTICED,
    Header,
    Index,
    bucket_bytes,
    check_secret,
    data_key,
    derived,
    written_header,
)
from keyss.channels.colours.lattice import MAX_BITS, seeds, write
from keyss.channels.colours.reading import ASSOCIATED
from keyss.core.arrays import Doubles, Flags
from keyss.core.errors import KeyssWarning, UsageError
from keyss.core.gaussians import Gaussians
from keyss.keys.derivation import MASTER_BYTES, expand, stream
from keyss.keys.encryption import OVERHEAD, compressed_size, encrypt
from keyss.rendering.difference import psnr_between

_TOO_FEW = "this cover has too few Gaussians to hide anything in colours that would survive other formats"
_LOWER = 3  # levels, each a quarter of a bit, by which a payload may lie lower than planned
_BITS_PER_GAUSSIAN = 1  # of room, about, beside headers
_HEADERS = 100  # bytes, about
_OVERHEAD = METHOD_BYTES + 1  # bytes of a payload beside its data, at most


@dataclass(frozen=True)
class Colours(Channel):
    """The channel; see `keyss.channels.base.Channel`. Raises UsageError for a `strength` of 0 dB or less."""

    strength: float = 45.0  # dB PSNR that views of a model keep at least, compared with those of the cover

    name = "colours"
    place = "colours"
    survives = True

    def __post_init__(self) -> None:
        if not (math.isfinite(self.strength) and self.strength > 0):
            raise UsageError(f"expected a `strength` above 0 dB, got {self.strength}")

    def prepare(self, cover: Gaussians) -> ColoursCover:
        return ColoursCover(Capacity(cover, Numbers.of(cover), self.strength))

    def room(self, gaussians: int, sh_degree: int) -> Room:
        capacity = gaussians * _BITS_PER_GAUSSIAN // 8 - _HEADERS
        return Room(gaussians, max(0, capacity), _OVERHEAD)


COLOURS = Colours()


@dataclass(frozen=True)
class ColoursCover:
    """A cover whose room is known; see `keyss.channels.base.PreparedCover`.

    Order and all numbers but some greens and blues stay. A payload changes as little as it needs; `strength`
    is a limit.
    """

    capacity: Capacity

    @property
    def cover(self) -> Gaussians:
        return self.capacity.model

    @cached_property
    def room(self) -> Room:
        return Room(len(self.capacity.own), self.capacity.bytes(MAX_BITS), _OVERHEAD)

    def embed(self, contents: Sequence[tuple[str, Content]], *, entropy: bytes | None = None) -> Gaussians:
        """See `PreparedCover`. Raises UsageError for a model that can carry nothing, too."""
        payloads = [pack_payload(content) for _, content in contents]
        secret = randomness(entropy, *payloads)
        random = np.random.default_rng(np.frombuffer(stream(secret, "colours/random", 32), np.uint32))
        numbers = renewed(self.capacity.numbers, random)
        salts = Salts.of(numbers)
        if len(salts.salts) < SALTS:
            raise UsageError(_TOO_FEW)
        sizes = [compressed_size(payload) + OVERHEAD for payload in payloads]
        layouts = self._layouts(sizes)
        writings = [
            _Writing(*derived(key, salts.salts), payload)
            for (key, _), payload in zip(contents, payloads, strict=True)
        ]
        check_keys([each.check for each in writings])
        # With more than one bit in a number, another secret would be noticed.
        if layouts[0].depth == 1:
            for index in range(len(contents), UNNOTICED):  # of nobody
                labels = [f"colours/nobody/{index}/{each}" for each in range(SALTS + 1)]
                static, *others = (expand(secret, label, MASTER_BYTES) for label in labels)
                writings.append(_Writing(static, tuple(others), None))
        likely = [layouts[min(index, len(layouts) - 1)].likely for index in range(len(writings))]
        for lower in range(_LOWER + 1):  # the cost of headers and salts is known only now
            headers = self._headers(layouts, sizes, secret, lower)[: len(writings)]
            stego = self._written(numbers, salts, writings, headers, likely, random)
            if psnr_between(self.cover, stego) >= self.capacity.strength:
                break
        return stego

    def _layouts(self, sizes: Sequence[int]) -> list[Layout]:
        """The layout of each payload."""
        alone = [self.capacity.layout([size]) for size in sizes]
        layouts = [own for own in alone if own is not None]
        noticed = len(sizes) > UNNOTICED
        if len(layouts) < len(sizes) or sum(own.shares[0] for own in layouts) > SHARES:
            together = self.capacity.layout(sizes)
            if together is None:
                raise UsageError(
                    f"the colours of this cover hold {self.room.capacity:,} bytes in all, and the secrets "
                    f"take {sum(sizes) - OVERHEAD * len(sizes):,}"
                )
            layouts = [replace(together, shares=(share,)) for share in together.shares]
            noticed = len(sizes) > 1
        if noticed:
            warnings.warn(NOTICED, KeyssWarning, stacklevel=4)
        return layouts

    def _headers(
        self, layouts: Sequence[Layout], sizes: Sequence[int], secret: bytes, lower: int
    ) -> list[Header]:
        """The header of each payload, and of decoys without a key, which look the same."""
        partition = expand(secret, "colours/partition", 2)
        headers, first = [], 0
        for index in range(max(len(layouts), UNNOTICED)):
            own, layout = index < len(layouts), layouts[min(index, len(layouts) - 1)]
            (share,) = layout.shares
            header = Header(
                file_key=expand(secret, f"colours/file-key/{index}", FILE_KEY_BYTES),
                partition=partition,
                level=max(0, layout.level - lower),
                depth=layout.depth,
                first=first if own else 0,
                last=first + share - 1 if own else 0,
                bucket=bucket_of(sizes[index]) if own else 0,
                idle=0,
            )
            first += share
            headers.append(header)
        return headers

    def _written(
        self,
        numbers: Numbers,
        salts: Salts,
        writings: Sequence[_Writing],
        headers: list[Header],
        likely: Sequence[bool],
        random: np.random.Generator,
    ) -> Gaussians:
        """The model with new salts, headers for all `writings`, and payloads of those that have one.

        Of `likely` ones, only numbers that leave the model as likely as it was are written, but all of a
        header if so few salts survive rounding that a header with gaps would be lost.
        """
        carriers = replace(self.capacity.carriers, values=numbers.colours[:, 1:])
        values = carriers.values.copy()
        free = np.zeros(len(carriers), bool)
        free[self.capacity.own_rows] = True
        free[salts.rows] = False
        free &= ~self.capacity.alone
        gaps = steady(numbers)
        index, own = Index(carriers), [header.own(carriers) for header in headers]
        holds, chosen = free.copy(), np.zeros(len(carriers), bool)  # written where that is likely
        for header, writing in zip(headers, writings, strict=True):
            for secret in writing.secrets:
                holds[index.rows(secret, header.kind)] = False
        admission = [self.capacity.admission if each else 1.0 for each in likely]
        idle = [
            1 - share * float(holds[each].mean()) if each.any() else 0.0
            for each, share in zip(own, admission, strict=True)
        ]
        headers = [
            replace(header, idle=min(31, round(share / IDLE)))
            for header, share in zip(headers, idle, strict=True)
        ]
        for salt in range(SALTS):  # a salt of every secret at a time: later ones find places taken
            for header, writing, some in zip(headers, writings, likely, strict=True):
                secret = writing.secrets[salt]
                rows, new = written_header(header, writing.check, secret, index, carriers, free)
                values[rows], chosen[rows], free[rows] = new, some and gaps, False
        for header, writing, mine, some in zip(headers, writings, own, likely, strict=True):
            if writing.payload is not None:
                rows, key = np.flatnonzero(free & mine), data_key(writing.static, header)
                encrypted = encrypt(key, writing.payload, ASSOCIATED, size=bucket_bytes(header.bucket))
                counts, code = header.bits(carriers[rows]), Fountain(8 * len(encrypted))
                words = seeds(key, "seeds", carriers.names[rows], counts)
                bits = code.encode(np.unpackbits(np.frombuffer(encrypted, np.uint8)), words)
                values[rows], chosen[rows] = write(key, carriers[rows], counts, bits), some
        return self._with_colours(values, chosen, random)

    def _with_colours(self, values: Doubles, chosen: Flags, random: np.random.Generator) -> Gaussians:
        """The model with another green and blue [C, 2] of its carriers; those that are equal stay.

        `chosen` [C]: carriers that change only where the new colour is as likely as the old one.
        """
        before = self.capacity.numbers.colours
        new = before.copy()
        for column in range(1, 3):
            changed = np.flatnonzero(values[:, column - 1] != before[:, column])
            rows = self.capacity.numbers.rows[changed]
            new[changed, column] = self.capacity.quiet.fitted(rows, column, values[changed, column - 1])
        if chosen.any():
            base = np.where(chosen[:, None], before, new)
            new[:, 1:] = np.where(self.capacity.likeness.admitted(base, new, random), new[:, 1:], base[:, 1:])
        sh = self.cover.sh.detach().clone()
        own = torch.from_numpy(self.capacity.numbers.rows).to(sh.device)
        sh[own, 0, 1:] = torch.from_numpy(new[:, 1:]).to(sh)
        return replace(self.cover.detach(), sh=sh)


@dataclass(frozen=True)
class _Writing:
    """The data to be written for one key."""

    static: bytes  # the key without a salt of the file
    secrets: tuple[bytes, ...]  # the key under each salt
    payload: bytes | None

    @property
    def check(self) -> bytes:
        return check_secret(self.static)
