"""Opening with a key, in whichever channel of a model the secret lies."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Protocol

from keyss.channels.base import Content, Reader
from keyss.core.errors import WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.files.formats.common import CodedGaussians
from keyss.keys.derivation import DerivedKey, KeyDerivation


def open_content(stego: Gaussians, key: str) -> Content:
    """What `key` opens in any channel. Raises WrongKeyError, and InputError for what is damaged."""
    for reader in _readers(stego):
        with suppress(WrongKeyError):
            return reader.open(key)
    raise WrongKeyError()


@dataclass(frozen=True)
class Attempt:
    """What a key opens under the likeliest salt, and what it becomes there."""

    key: DerivedKey
    content: Content | None
    appended: bool  # whether there are appended Gaussians


def quick_attempt(stego: Gaussians, key: str) -> Attempt | None:
    """A single attempt, which takes a wrong key as long as a right one; None where nothing can be read.

    Raises InputError for what is damaged.
    """
    from keyss.channels.appended.channel import APPENDED

    appended = APPENDED.reader(stego)  # everybody sees that they are there
    reader = appended or _exact(stego)
    if reader is None or not reader.salts:
        return None
    derived = DerivedKey(key, KeyDerivation(salt=reader.salts[0]))
    content = None
    with suppress(WrongKeyError):
        content = reader.extract(derived)
    return Attempt(derived, content, appended is not None)


class _SaltedReader(Reader, Protocol):
    """A reader that tries a key under one salt at a time."""

    @property
    def salts(self) -> Sequence[bytes]:
        """The likeliest first."""

    def extract(self, key: DerivedKey) -> Content:
        """`open` after key derivation."""


def _readers(stego: Gaussians) -> Iterator[Reader]:
    """The channels in which something may lie, each loaded when the ones before opened nothing."""
    if exact := _exact(stego):
        yield exact
    from keyss.channels.appended.channel import APPENDED

    if appended := APPENDED.reader(stego):
        yield appended
    from keyss.channels.colours.channel import Colours

    yield Colours().reader(stego)


def _exact(stego: Gaussians) -> _SaltedReader | None:
    """What reads bits that only the very file has: codes where there are some, else low bits."""
    if isinstance(stego, CodedGaussians):
        from keyss.channels.codes.channel import CodesChannel

        return CodesChannel("spz").reader(stego)  # of codes of any format
    from keyss.channels.low_bits.channel import LOW_BITS

    return LOW_BITS.reader(stego)
