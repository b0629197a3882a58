"""The protocol of all channels: places in a published model where bits are stored and found with a key.

A channel does not interpret its bits. It carries *payloads*, bytes that are read completely or not at all.

How a model is published determines its channel (`publishing`); readers try all channels.
"""

from __future__ import annotations

import hashlib
import os
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import ClassVar, Protocol

import numpy as np
import torch

from keyss.core.errors import InputError, KeyssWarning, UsageError, WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.keys.derivation import DerivedKey

METHOD_BYTES = 15  # maximum length of a method's name
_MAX_COPIES = 0.1  # share of a sound model; one public model has 0.035, all others less
_VISIBLE = 2 / 255  # opacity, above that of appended Gaussians
SALTS_TRIED = 4  # with half of the Gaussians changed, 15 of 16 models still open
NOT_INDEPENDENT = (
    "the secrets are too large, or too many, to be placed independently of each other: whoever holds one of "
    "the keys can notice that there are other secrets"
)
_FOREIGN = (
    "about {:,} Gaussians were added to the file or changed after the secret was hidden, so an attacker may "
    "have chosen which secret the key opens: reveal it from the file as it was published"
)


@dataclass(frozen=True)
class Payload:
    """Bytes that are read completely or not at all."""

    method: str  # 1 to METHOD_BYTES ASCII characters
    data: bytes
    shards: tuple[int, int] | None = field(default=None, compare=False)  # read and written; None: not divided
    model_size: int | None = field(default=None, compare=False)  # Gaussians of the model it was read from
    foreign: int = field(default=0, compare=False)  # estimate of those added or changed after hiding


def check_method(name: str) -> bytes:
    """The name of a method in ASCII. Raises ValueError unless it has 1 to METHOD_BYTES characters."""
    encoded = name.encode("ascii")
    if not 1 <= len(encoded) <= METHOD_BYTES:
        raise ValueError(f"expected the name of a method, 1 to {METHOD_BYTES} characters, got {name!r}")
    return encoded


def pack_method(name: str) -> bytes:
    """The name of a method, padded to METHOD_BYTES."""
    return check_method(name).ljust(METHOD_BYTES, b"\0")


def unpack_method(packed: bytes) -> str:
    """Invert `pack_method`. Raises ValueError for anything else."""
    return packed[:METHOD_BYTES].rstrip(b"\0").decode("ascii")


@dataclass(frozen=True)
class Capacity:
    """The capacity of a cover: exact for a prepared cover, an estimate before it is fitted."""

    bytes: int  # of one payload
    overhead: int  # maximum bytes of a payload beside its data
    further: float = 1.0  # each payload after the first multiplies the bytes of all together by this
    # Shares of one payload: part of the carriers, and bytes; None: a quarter, a half and all of `bytes`.
    steps: tuple[tuple[float, int], ...] | None = None
    equal: Callable[[int], int] | None = None  # bytes of each of several equal payloads; None: equal parts
    divisible: bool = True  # False: several payloads have equal shares
    grows: bool = False  # True if the model grows with the hidden data, which should then be short


class PreparedCover(Protocol):
    """A cover with known capacity in a channel."""

    @property
    def cover(self) -> Gaussians:
        """The cover."""

    @property
    def capacity(self) -> Capacity:
        """Its capacity."""

    def embed(self, payloads: Sequence[tuple[str, Payload]], *, entropy: bytes | None = None) -> Gaussians:
        """Embed one (key, payload) per secret.

        `entropy`: at least 32 secret bytes from which all randomness is derived; by default the system's.
        Raises UsageError for equal keys and for payloads that do not fit. Warns (KeyssWarning) if the holder
        of one key can tell that there are other secrets.
        """


class Reader(Protocol):
    """Reads the secrets of a stego model from one channel."""

    def open(self, key: str) -> Payload:
        """The payload that `key` opens. Raises WrongKeyError if it opens nothing, InputError for damage."""


class SaltedReader(ABC):
    """A `Reader` that tries a key with one salt of Argon2id after another."""

    salts: Sequence[bytes]  # the likeliest first

    @abstractmethod
    def extract(self, key: DerivedKey) -> Payload:
        """`open`, after key derivation with one salt."""

    def open(self, key: str) -> Payload:
        """See `Reader`. Changed or added Gaussians can replace the first salt, so several are tried.

        Each takes 0.1 s. Warns as `warned` does.
        """
        for salt in self.salts[:SALTS_TRIED]:
            with suppress(WrongKeyError):
                return warned(self.extract(DerivedKey.of(key, salt)))
        raise WrongKeyError()


def warned(payload: Payload) -> Payload:
    """The payload; warns (KeyssWarning) of Gaussians that were added or changed after hiding."""
    if payload.foreign:
        warnings.warn(_FOREIGN.format(payload.foreign), KeyssWarning, stacklevel=4)
    return payload


def copies(model: Gaussians) -> tuple[int, bool]:
    """The number of visible Gaussians with the position and the red of another; True if it is suspicious.

    Two files of one cover, put into one, have many: no channel changes these numbers.
    """
    visible = model[model.opacities > _VISIBLE].detach().to("cpu")
    rows = torch.cat([visible.means, visible.sh[:, 0, :1]], dim=1).numpy() + np.float32(0)  # no -0
    weights = np.frombuffer(os.urandom(32), np.uint64)  # random: nobody can prepare equal hashes
    count = len(rows) - len(np.unique(rows.view(np.uint32).astype(np.uint64) @ weights))
    return count, count > _MAX_COPIES * len(rows)


class Channel(ABC):
    """A place for bits in a model."""

    place: str  # in messages: "low bits", "spz codes" and so on
    survives: ClassVar[bool] = False  # True if secrets survive conversion to other formats
    grows: ClassVar[bool] = False  # see `Capacity`

    @abstractmethod
    def prepare(self, cover: Gaussians) -> PreparedCover:
        """Find the carriers. Raises UsageError for a cover without capacity, or if changes would be visible.

        Raises OutputError for a cover that the published format cannot hold.
        """

    @abstractmethod
    def estimate_capacity(self, gaussians: int, sh_degree: int) -> Capacity:
        """Estimate the capacity of a cover that is not fitted yet."""


def pack_payload(payload: Payload) -> bytes:
    """Pack a payload: name of the method, zero byte, data."""
    return check_method(payload.method) + b"\0" + payload.data


def unpack_payload(packed: bytes) -> Payload:
    """Invert `pack_payload`. Raises InputError for anything else."""
    name, zero, data = packed.partition(b"\0")
    try:
        check_method(name.decode("ascii"))
    except ValueError as error:
        raise InputError("the hidden data are damaged: they do not begin with a method's name") from error
    if not zero:
        raise InputError("the hidden data are damaged: they are incomplete")
    return Payload(name.decode("ascii"), data)


def randomness(entropy: bytes | None, *parts: bytes) -> bytes:
    """32 bytes derived from `entropy` and all hidden data, so that no two files share derived values.

    `entropy`: at least 32 secret bytes; None: the system's.
    """
    entropy = os.urandom(32) if entropy is None else entropy
    if len(entropy) < 32:
        raise ValueError(f"expected at least 32 bytes of entropy, got {len(entropy)}")
    return hashlib.sha256(b"".join(hashlib.sha256(part).digest() for part in (entropy, *parts))).digest()


def check_keys(verifiers: Sequence[bytes]) -> None:
    """Raise UsageError unless there is a key, and no two are equal."""
    if not verifiers or len(set(verifiers)) < len(verifiers):
        raise UsageError("two secrets have the same key: expected at least one secret, each with its own")
