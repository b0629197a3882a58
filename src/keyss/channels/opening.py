"""Opening with a key, in whichever channel of a model the secret lies."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace

from keyss.channels.base import Content, Payload, Reader, SaltedReader
from keyss.core.errors import WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.files.formats.common import CodedGaussians
from keyss.keys.derivation import DerivedKey


def open_content(stego: Gaussians, key: str) -> Content:
    """The content that `key` opens in any channel. Raises WrongKeyError, and InputError for damage."""
    for reader in _readers(stego):
        with suppress(WrongKeyError):
            return _read_from(stego, reader.open(key))
    raise WrongKeyError()


@dataclass(frozen=True)
class Attempt:
    """A key under the likeliest salt, and what it opens there."""

    key: DerivedKey
    content: Content | None
    appended: bool  # True if there are appended Gaussians


def quick_attempt(stego: Gaussians, key: str) -> Attempt | None:
    """A single attempt, which takes as long for a wrong key as for a right one; None without a salt.

    Raises InputError for damage.
    """
    appended = _appended(stego)  # everybody sees that they are there
    reader = appended or _exact(stego)
    if reader is None or not reader.salts:
        return None
    derived = DerivedKey.of(key, reader.salts[0])
    content = None
    with suppress(WrongKeyError):
        content = _read_from(stego, reader.extract(derived))
    return Attempt(derived, content, appended is not None)


def _read_from(stego: Gaussians, content: Content) -> Content:
    return replace(content, carriers=len(stego)) if isinstance(content, Payload) else content


def _readers(stego: Gaussians) -> Iterator[Reader]:
    """The readers of a model; each channel is loaded when the ones before opened nothing."""
    for reader in (_exact, _appended):
        if own := reader(stego):
            yield own
    from keyss.channels.colours.reading import ColoursReader

    yield ColoursReader.of(stego)


def _exact(stego: Gaussians) -> SaltedReader | None:
    """The reader of bits that only the very file has: codes of a coded file, else low bits."""
    if isinstance(stego, CodedGaussians):
        from keyss.channels.codes.channel import CodesReader

        return CodesReader.of(stego.codes)
    from keyss.channels.low_bits.reading import LowBitsReader

    return LowBitsReader.of(stego)


def _appended(stego: Gaussians) -> SaltedReader | None:
    from keyss.channels.appended.channel import AppendedReader

    return AppendedReader.of(stego)
