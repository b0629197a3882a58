"""Bytes in a model that come out of it after formats that round, whatever became of its order or its frame.

A payload is encrypted and authenticated (ChaCha20-Poly1305), made into code bits (`fountain`), and written
into colours (`lattice`) of Gaussians that are known by what else they are (`carriers`). A *header* under a
few *salts* holds how it is read; see `header` and `salts`. A key opens its own: nothing in the model tells
how many secrets there are, or that there are any.
"""

from __future__ import annotations

import hashlib
import os
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import torch

from keyss.channels.robust.carriers import Doubles, Numbers
from keyss.channels.robust.fountain import Fountain
from keyss.channels.robust.header import (
    FILE_KEY_BYTES,
    IDLE,
    SHARES,
    UNNOTICED,
    Header,
    Index,
    bucket_bytes,
    check_secret,
    written_header,
)
from keyss.channels.robust.lattice import SPACINGS
from keyss.channels.robust.likeness import Likeness
from keyss.channels.robust.payload import OVERHEAD, encrypt_payload
from keyss.channels.robust.room import Layout, Room, bucket_of
from keyss.channels.robust.salts import SALTS, Salts, moved, renewed, steady
from keyss.core.errors import InputError, KeyssWarning, UsageError
from keyss.core.gaussians import Gaussians
from keyss.keys.derivation import MASTER_BYTES, SALT_BYTES, DerivedKey, KeyDerivation, expand, stream
from keyss.rendering.difference import cost

STRENGTH = 45.0  # dB
Key = str | Callable[[bytes], DerivedKey]  # text, or what it becomes with a salt

_LOWER = 3  # levels, each a quarter of a bit, by which a payload may lie lower than planned
_STATIC_SALT = hashlib.sha256(b"keyss/v1/robust-static").digest()[:SALT_BYTES]
_TOO_FEW = "this model has too few Gaussians to hide anything that survives other formats"
_NOTICED = (
    "the secrets are too large, or too many, to lie in this model as each would alone: who holds one of the "
    "keys can notice that there are other secrets"
)


def capacity(model: Gaussians, *, strength: float = STRENGTH, spacing: float = SPACINGS[0]) -> int:
    """Bytes that one payload may have at most.

    `strength`: PSNR in dB that views of the model have to keep beside those of the model before. `spacing`:
    of the lattice; a larger one survives more noise and costs more. Raises UsageError and InputError.
    """
    return RobustCover.of(model, spacing).capacity(strength)


def embed(
    model: Gaussians,
    contents: Sequence[tuple[Key, bytes]],
    *,
    strength: float = STRENGTH,
    spacing: float = SPACINGS[0],
    entropy: bytes | None = None,
) -> Gaussians:
    """The model with one (key, payload) for each secret in it; order and all other numbers stay.

    A payload changes as little as it needs: `strength` is the most that it may cost. `entropy`: at least 32
    bytes that nobody else can know, from which all that is random is derived; by default the system's.
    Raises UsageError for equal keys and for what does not fit, InputError for a model that can carry nothing.
    Warns (KeyssWarning) where the holder of one key can notice that there are other secrets.
    """
    return RobustCover.of(model, spacing).embed(contents, strength=strength, entropy=entropy)


@dataclass(frozen=True)
class RobustCover:
    """A model whose room is known."""

    room: Room

    @staticmethod
    def of(model: Gaussians, spacing: float = SPACINGS[0]) -> RobustCover:
        if spacing not in SPACINGS:
            raise UsageError(f"expected a `spacing` of {', '.join(map(str, SPACINGS))}, got {spacing}")
        return RobustCover(Room(model, Numbers.of(model), SPACINGS.index(spacing)))

    @property
    def model(self) -> Gaussians:
        return self.room.model

    def capacity(self, strength: float = STRENGTH) -> int:
        """See `capacity`."""
        return self.room.capacity(strength)

    def quiet_capacity(self, strength: float = STRENGTH) -> int:
        """Bytes that go into one bit of each number."""
        return self.room.quiet_capacity(strength)

    def likely_capacity(self, strength: float = STRENGTH) -> int:
        """Bytes that leave all numbers as likely as they were, and are hard to tell (see docs/robust.md)."""
        return self.room.likely_capacity(strength)

    def embed(
        self,
        contents: Sequence[tuple[Key, bytes]],
        *,
        strength: float = STRENGTH,
        entropy: bytes | None = None,
    ) -> Gaussians:
        """See `embed`."""
        mixed = hashlib.sha256(os.urandom(32) if entropy is None else entropy)
        for _, payload in contents:
            mixed.update(hashlib.sha256(payload).digest())
        if not contents:
            raise UsageError("expected at least one secret, got none")
        secret = mixed.digest()
        random = np.random.default_rng(np.frombuffer(stream(secret, "robust/random", 32), np.uint32))
        if len(Salts.of(self.room.numbers).salts) < SALTS:
            raise InputError(_TOO_FEW)
        sizes = [len(payload) + OVERHEAD for _, payload in contents]
        layouts = self._layouts(sizes, strength)
        jumps = self._jumps(random) if layouts[0].likely else None
        numbers = renewed(self.room.numbers, random, jumps)
        salts = Salts.of(numbers)
        if len(salts.salts) < SALTS:  # two are equal now, which hardly ever happens
            raise InputError(_TOO_FEW)
        writings = [_Writing.of(key, payload, salts) for key, payload in contents]
        if len({each.check for each in writings}) != len(writings):
            raise UsageError("two secrets have the same key: expected each with its own")
        if (
            layouts[0].lattice.depth == 1
        ):  # else there is no room for another secret that would not be noticed
            writings += [_Writing.of_nobody(secret, index) for index in range(len(contents), UNNOTICED)]
        for lower in range(_LOWER + 1):  # what headers and salts cost is known only now
            headers = self._headers(layouts, sizes, secret, lower)[: len(writings)]
            likely = [layouts[min(index, len(layouts) - 1)].likely for index in range(len(writings))]
            stego = self._written(numbers, salts, writings, headers, likely, random)
            if cost(self.model, stego) >= strength:
                break
        return stego

    def _jumps(self, random: np.random.Generator) -> Likeness:
        """What is usual in colours, for moves of salts."""
        colours = self.room.numbers.colours
        return self.room.likeness.learned(colours, moved(colours, random))

    def _layouts(self, sizes: Sequence[int], strength: float) -> list[Layout]:
        """Of each payload."""
        each = [self.room.layout([size], strength) for size in sizes]
        found = [own for own in each if own is not None]
        noticed = len(sizes) > UNNOTICED
        if len(found) < len(sizes) or sum(own.shares[0] for own in found) > SHARES:
            together: Layout | None = self.room.layout(sizes, strength)
            if together is None:
                room = self.room.capacity(strength)
                raise UsageError(
                    f"expected payloads of {room:,} bytes in all, as this model holds at this `strength`, "
                    f"got {sum(sizes) - OVERHEAD * len(sizes):,} bytes in {len(sizes)}"
                )
            found = [replace(together, shares=(share,)) for share in together.shares]
            noticed = len(sizes) > 1
        if noticed:
            warnings.warn(_NOTICED, KeyssWarning, stacklevel=4)
        return found

    def _headers(
        self, layouts: Sequence[Layout], sizes: Sequence[int], secret: bytes, lower: int
    ) -> list[Header]:
        """Of each payload, and of those that nobody has: these differ in nothing but what is in them."""
        partition = expand(secret, "robust/partition", 2)
        headers, first = [], 0
        for index in range(max(len(layouts), UNNOTICED)):
            layout = layouts[min(index, len(layouts) - 1)]
            (share,) = layout.shares
            own = index < len(layouts)
            header = Header(
                file_key=expand(secret, f"robust/file-key/{index}", FILE_KEY_BYTES),
                partition=partition,
                level=max(0, layout.lattice.level - lower),
                spacing=self.room.spacing,
                depth=layout.lattice.depth,
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

        Of those that are `likely` only as much as leaves the model as likely as it was; all of a header
        where salts are so few after rounding that it would be lost with gaps.
        """
        carriers = replace(self.room.carriers, values=numbers.colours[:, 1:])
        values = carriers.values.copy()
        free = np.zeros(len(carriers), bool)
        free[self.room.own_rows] = True
        free[salts.rows] = False
        free &= ~self.room.alone
        gaps = steady(numbers)
        index, own = Index(carriers), [header.own(carriers) for header in headers]
        holds, chosen = free.copy(), np.zeros(len(carriers), bool)  # written where that is likely
        for header, writing in zip(headers, writings, strict=True):
            for secret in writing.secrets:
                holds[index.rows(index.places(secret, header.kind.places))] = False
        admission = [self.room.admission if each else 1.0 for each in likely]
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
                encrypted = encrypt_payload(key, writing.payload, bucket_bytes(header.bucket))
                code, lattice = Fountain.of(8 * len(encrypted)), header.lattice
                seeds = lattice.seeds(key, carriers[rows])
                bits = code.encode(np.unpackbits(np.frombuffer(encrypted, np.uint8)), seeds)
                values[rows], chosen[rows] = lattice.write(key, carriers[rows], bits), some
        return self._with_colours(values, chosen, random)

    def _with_colours(
        self, values: Doubles, chosen: npt.NDArray[np.bool_], random: np.random.Generator
    ) -> Gaussians:
        """The model with another green and blue [C, 2] of its carriers; those that are equal stay.

        `chosen` [C]: of which only those change that are as likely as before.
        """
        before = self.room.numbers.colours
        new, most = before.copy(), SPACINGS[self.room.spacing] / 2
        for column in range(1, 3):
            changed = np.flatnonzero(values[:, column - 1] != before[:, column])
            rows = self.room.numbers.rows[changed]
            new[changed, column] = self.room.quiet.fitted(rows, column, values[changed, column - 1], most)
        if chosen.any():
            base = np.where(chosen[:, None], before, new)
            new[:, 1:] = np.where(self.room.likeness.admitted(base, new, random), new[:, 1:], base[:, 1:])
        sh = self.model.sh.detach().clone()
        own = torch.from_numpy(self.room.numbers.rows).to(sh.device)
        sh[own, 0, 1:] = torch.from_numpy(new[:, 1:]).to(sh)
        return replace(self.model.detach(), sh=sh)


@dataclass(frozen=True)
class _Writing:
    """What is written for one key."""

    static: bytes  # what the key becomes without a salt of the file
    secrets: tuple[bytes, ...]  # what it becomes with each
    payload: bytes | None

    @property
    def check(self) -> bytes:
        return check_secret(self.static)

    @staticmethod
    def of(key: Key, payload: bytes, salts: Salts) -> _Writing:
        return _Writing(*derived(key, salts), payload)

    @staticmethod
    def of_nobody(secret: bytes, index: int) -> _Writing:
        every = [expand(secret, f"robust/nobody/{index}/{each}", MASTER_BYTES) for each in range(SALTS + 1)]
        return _Writing(every[0], tuple(every[1:]), None)


def derived(key: Key, salts: Salts) -> tuple[bytes, tuple[bytes, ...]]:
    """What a key becomes without a salt of the file, and with each; text takes about 0.1 s for each.

    The salts make every guess cost Argon2id anew for each file. The other secret makes up for the few bytes
    of a header: whoever does not know the key has to guess both.
    """
    secrets = [_derive(key, salt).expand("robust/header", 32) for salt in salts.salts]
    return _derive(key, _STATIC_SALT).expand("robust/static", 32), tuple(secrets)


def data_key(static: bytes, header: Header) -> bytes:
    """What a payload is encrypted with: nobody has it without the key, and no two files have the same."""
    return expand(static + header.file_key, "robust/data-key", 32)


def _derive(key: Key, salt: bytes) -> DerivedKey:
    return DerivedKey(key, KeyDerivation(salt=salt)) if isinstance(key, str) else key(salt)
