"""Bytes in a model that come out of it after formats that round, whatever became of its order or its frame.

A payload is encrypted and authenticated (ChaCha20-Poly1305), made into as many code bits as there is room for
(`fountain`), and written into colours (`lattice`) of Gaussians that are known by what else they are
(`carriers`). A *header* for each of a few *salts* holds the data key; see `header` and `salts`. A key opens
its header under the salt alone, and everything else by the data key: nothing in the model tells how many
secrets there are, or that there are any.
"""

from __future__ import annotations

import hashlib
import math
import os
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt
import torch

from keyss.channels.robust.carriers import CELL, Carriers, Doubles, Numbers
from keyss.channels.robust.fountain import Fountain
from keyss.channels.robust.header import (
    CLASSES,
    DATA_KEY_BYTES,
    LATTICE,
    UNNOTICED,
    Header,
    bucket_bytes,
    class_of,
    header_share,
    places,
    write_header,
)
from keyss.channels.robust.lattice import COLUMNS, LEVELS, SPACINGS, Lattice
from keyss.channels.robust.payload import OVERHEAD, encrypt_payload
from keyss.channels.robust.salts import SALTS, Salts, renewed
from keyss.core.errors import InputError, KeyssWarning, UsageError
from keyss.core.gaussians import Gaussians
from keyss.keys.derivation import MASTER_BYTES, DerivedKey, KeyDerivation, expand, stream
from keyss.rendering.difference import cost

STRENGTH = 45.0  # dB
Key = str | Callable[[bytes], DerivedKey]  # text, or what it becomes with a salt

_RATE = 0.42  # data bits for each bit of information that is expected to be read
_GARBAGE = 0.02  # share of carriers whose name has changed although it seemed safe
_SHARES = (2, 4, 8)  # classes that a payload gets, by its size
_LOWER = 3  # levels, each a quarter of a bit, by which a payload may lie lower than planned
_SPREAD = 0.5  # dB by which what is written may cost more than what was measured
_COMFORTABLE = 0.6  # of what they hold, unless it gets all
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

    `entropy`: at least 32 bytes that nobody else can know, from which all that is random is derived; by
    default the system's. Raises UsageError for equal keys and for what does not fit, InputError for a model
    that can carry nothing. Warns (KeyssWarning) where the holder of one key can notice that there are other
    secrets.
    """
    return RobustCover.of(model, spacing).embed(contents, strength=strength, entropy=entropy)


@dataclass(frozen=True)
class RobustCover:
    """A model whose room is known."""

    model: Gaussians
    numbers: Numbers
    spacing: int  # index into SPACINGS
    measured: dict[int, float] = field(default_factory=dict, compare=False)  # costs of levels

    @staticmethod
    def of(model: Gaussians, spacing: float = SPACINGS[0]) -> RobustCover:
        if spacing not in SPACINGS:
            raise UsageError(f"expected a `spacing` of {', '.join(map(str, SPACINGS))}, got {spacing}")
        return RobustCover(model, Numbers.of(model), SPACINGS.index(spacing))

    def capacity(self, strength: float = STRENGTH) -> int:
        """See `capacity`."""
        return max(0, self._largest(self._level(strength), CLASSES) - OVERHEAD) if len(self._own) else 0

    def cost(self, level: int) -> float:
        """PSNR in dB that a payload in all carriers leaves with its headers, at this level of the lattice."""
        random = np.random.default_rng(0)
        noise = self._lattice(level).noise(self._own, random)
        headers = random.random(len(self._own)) < self._headers_share
        noise[headers] = LATTICE.noise(self._own[headers], random)
        colours = self.numbers.colours.copy()
        colours[self._own_rows, 1:] += noise
        return cost(self.model, self._with_colours(colours))

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
        numbers = renewed(self.numbers, random)
        salts = Salts.of(numbers)
        if len(salts.salts) < SALTS:
            raise InputError("this model has too few Gaussians to hide anything that survives other formats")
        level = self._level(strength)
        headers = self._headers(contents, level, secret, random)
        derived = [[derive(key, each) for each in salts.salts[:SALTS]] for key, _ in contents]
        if len({keys[0].verifier() for keys in derived}) != len(contents):
            raise UsageError("two secrets have the same key: expected each with its own")
        for index in range(len(contents), UNNOTICED):  # nobody has these keys
            nobody = [expand(secret, f"robust/nobody/{index}/{each}", MASTER_BYTES) for each in range(SALTS)]
            derived.append([DerivedKey.of_master(each) for each in nobody])
            headers.append(Header(nobody[0][:DATA_KEY_BYTES], level, self.spacing, 0, 0))
        payloads = [payload for _, payload in contents]
        for lower in range(_LOWER + 1):  # what headers and salts cost is known only now
            fitting = [replace(each, level=max(0, level - lower)) for each in headers]
            stego = self._written(numbers, salts, fitting, derived, payloads)
            if cost(self.model, stego) >= strength:
                break
        return stego

    def _written(
        self,
        numbers: Numbers,
        salts: Salts,
        headers: list[Header],
        derived: list[list[DerivedKey]],
        payloads: list[bytes],
    ) -> Gaussians:
        """The model with new salts, headers for each of the `derived` keys, and payloads of the first."""
        colours = numbers.colours.copy()
        carriers = numbers.carriers(_reference(numbers))
        free = np.zeros(len(carriers), bool)
        free[carriers.one_of_each()] = True
        free[salts.rows] = False
        for each in range(SALTS):  # the best salt of every secret first: later headers find places taken
            for keys, header in zip(derived, headers, strict=True):
                self._header(colours, carriers, free, keys[each], header)
        classes = class_of(carriers)
        for header, payload in zip(headers, payloads, strict=False):
            own = np.flatnonzero(free & (header.classes >> classes & 1 == 1))
            encrypted = encrypt_payload(header.data_key, payload, bucket_bytes(header.bucket))
            code = Fountain.of(8 * len(encrypted))
            seeds = header.lattice.seeds(header.data_key, carriers[own])
            bits = code.encode(np.unpackbits(np.frombuffer(encrypted, np.uint8)), seeds)
            colours[own, 1:] = header.lattice.write(header.data_key, carriers[own], bits)
        return self._with_colours(colours)

    @staticmethod
    def _header(
        colours: Doubles, carriers: Carriers, free: npt.NDArray[np.bool_], key: DerivedKey, header: Header
    ) -> None:
        """Write a header where it belongs, except where there is something; its carriers are free no more."""
        secret = key.expand("robust/header", 32)
        own = places(secret, carriers)[0]
        own = own[free[own]]
        colours[own, 1:] = write_header(header, secret, carriers[own])
        free[own] = False

    def _headers(
        self, contents: Sequence[tuple[Key, bytes]], level: int, secret: bytes, random: np.random.Generator
    ) -> list[Header]:
        sizes = [len(payload) + OVERHEAD for _, payload in contents]
        noticed = len(sizes) > UNNOTICED
        shares = [self._share(size / _COMFORTABLE, level, _SHARES[:-1], CLASSES) for size in sizes]
        if sum(shares) > CLASSES:
            shares = [self._share(size, level, range(1, CLASSES + 1), CLASSES + 1) for size in sizes]
            noticed = len(sizes) > 1
        if sum(shares) > CLASSES or max(sizes) > self._largest(level, CLASSES):
            room = max(0, self._largest(level, CLASSES) - OVERHEAD)
            raise UsageError(
                f"expected payloads of {room:,} bytes in all, as this model holds at this `strength`, "
                f"got {sum(sizes) - OVERHEAD * len(sizes):,} bytes in {len(sizes)}"
            )
        if noticed:
            warnings.warn(_NOTICED, KeyssWarning, stacklevel=4)
        order, headers = random.permutation(CLASSES), []
        for index, (size, share) in enumerate(zip(sizes, shares, strict=True)):
            own, order = order[:share], order[share:]
            data_key = expand(secret, f"robust/data-key/{index}", DATA_KEY_BYTES)
            mask = int(sum(1 << int(each) for each in own))
            headers.append(Header(data_key, level, self.spacing, mask, _bucket(size)))
        return headers

    def _share(self, size: float, level: int, shares: Sequence[int], otherwise: int) -> int:
        """The least number of classes that holds `size` bytes."""
        return next((each for each in shares if self._largest(level, each) >= size), otherwise)

    def _largest(self, level: int, classes: int) -> int:
        """Bytes of the largest bucket that so many classes hold."""
        bits = COLUMNS * self._lattice(level).bits(self._own)
        room = _RATE * float((bits * self._information).sum()) * classes / CLASSES / 8
        return max((bucket_bytes(each) for each in range(256) if bucket_bytes(each) <= room), default=0)

    def _level(self, strength: float) -> int:
        """The largest level that costs no more than `strength` allows, or the least of all."""
        if not (math.isfinite(strength) and strength > 0):
            raise UsageError(f"expected a `strength` above 0 dB, got {strength}")
        least, beyond = 0, LEVELS
        while beyond - least > 1:
            middle = (least + beyond) // 2
            least, beyond = (middle, beyond) if self._costs(middle) >= strength + _SPREAD else (least, middle)
        return least

    def _costs(self, level: int) -> float:
        if level not in self.measured:
            self.measured[level] = self.cost(level)
        return self.measured[level]

    def _lattice(self, level: int) -> Lattice:
        return Lattice(level, SPACINGS[self.spacing])

    @cached_property
    def _carriers(self) -> Carriers:
        return self.numbers.carriers(_reference(self.numbers))

    @cached_property
    def _own_rows(self) -> npt.NDArray[np.int64]:
        """[D] those that are written."""
        return self._carriers.one_of_each()

    @cached_property
    def _own(self) -> Carriers:
        return self._carriers[self._own_rows]

    @cached_property
    def _headers_share(self) -> float:
        """Of carriers, those that headers take."""
        return min(1.0, UNNOTICED * header_share(self._own))

    @cached_property
    def _information(self) -> Doubles:
        """[D] bits that a reader is expected to have of each bit that one of them carries."""
        namesakes = self._carriers.namesakes()[self._own_rows]
        garbage = 1 - (1 - _GARBAGE) * (1 - self._own.doubt) / namesakes
        return (1 - self._headers_share) * (1 - _entropy(garbage / 2))

    def _with_colours(self, colours: Doubles) -> Gaussians:
        """The model with other constant colours [C, 3] of its carriers; those that are equal stay as they
        are.
        """
        sh = self.model.sh.detach().clone()
        changed = (colours != self.numbers.colours).any(axis=1)
        rows = torch.from_numpy(self.numbers.rows[changed]).to(sh.device)
        sh[rows, 0] = torch.from_numpy(colours[changed]).to(sh)
        return replace(self.model.detach(), sh=sh)


def derive(key: Key, salt: bytes) -> DerivedKey:
    """What a key becomes with a salt; text takes about 0.1 s."""
    return DerivedKey(key, KeyDerivation(salt=salt)) if isinstance(key, str) else key(salt)


def _reference(numbers: Numbers) -> float:
    """What a writer takes for a log scale of zero: a multiple of CELL."""
    return float(np.round(numbers.size / CELL) * CELL)


def _bucket(size: int) -> int:
    """The least bucket that holds `size` bytes."""
    return next(each for each in range(256) if bucket_bytes(each) >= size)


def _entropy(chance: Doubles) -> Doubles:
    """[...] of bits that are wrong by this chance, at most a half."""
    p = chance.clip(1e-12, 0.5)
    result: Doubles = -p * np.log2(p) - (1 - p) * np.log2(1 - p)
    return result
