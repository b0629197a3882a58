"""The channel for each place of publication, and opening with a key in whichever channel a secret lies."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Literal, get_args

from keyss.channels.base import Channel, Content, Payload, Reader, SaltedReader
from keyss.core.errors import UsageError, WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.files.formats.common import CodedGaussians
from keyss.keys.derivation import DerivedKey

Publish = Literal["auto", "ply", "spz", "sog", "compressed-ply", "any"]
AnyChannel = Literal["appended", "colours"]  # of a model that may be converted to any format

SUFFIXES = {"spz": ".spz", "sog": ".sog", "compressed-ply": ".compressed.ply"}  # of files whose codes carry


def channel_for(publish: Publish, channel: AnyChannel = "appended") -> Channel:
    """The channel for a model that is published in the format `publish`, or as "any".

    Loads that channel only. Raises UsageError for unknown names.
    """
    if publish not in get_args(Publish) or channel not in get_args(AnyChannel):
        raise UsageError(
            f"expected a format to publish in ({', '.join(get_args(Publish))}), and "
            f"{' or '.join(get_args(AnyChannel))} for any, got {publish!r} and {channel!r}"
        )
    if publish in ("auto", "ply"):
        from keyss.channels.low_bits.channel import LOW_BITS

        return LOW_BITS
    if publish != "any":
        from keyss.channels.codes.channel import CodesChannel

        return CodesChannel(publish)
    if channel == "appended":
        from keyss.channels.appended.channel import APPENDED

        return APPENDED
    from keyss.channels.colours.channel import COLOURS

    return COLOURS


def quiet_channel(channel: Channel, cover: Gaussians) -> Channel:
    """The place that `cover` has for `channel`: of low bits its codes, if it was decoded from some."""
    if channel.name == "low_bits":
        from keyss.channels.codes.channel import DecodedChannel
        from keyss.channels.codes.decoded import Decoded

        if decoded := Decoded.of(cover):
            return DecodedChannel(decoded)
    return channel


def suffix_of(stego: Gaussians) -> str:
    """The suffix of a file that keeps everything a published model carries."""
    if not isinstance(stego, CodedGaussians):
        return ".ply"
    return SUFFIXES[stego.codes.name]


def open_content(stego: Gaussians, key: str) -> Content:
    """The content that `key` opens in any channel. Raises WrongKeyError, and InputError for damage."""
    for reader in _readers(stego):
        with suppress(WrongKeyError):
            return _read_from(stego, reader.open(key))
    raise WrongKeyError()


@dataclass(frozen=True)
class Attempt:
    """A key under the likeliest salt, and the content that it opens."""

    key: DerivedKey
    content: Content | None
    appended: bool  # True if there are appended Gaussians
    records: bool  # True if scenes lie there as records, else as one payload


def quick_attempt(stego: Gaussians, key: str) -> Attempt | None:
    """A single attempt, which takes as long for a wrong key as for a right one; None without a salt.

    Raises InputError for damage.
    """
    appended = _appended(stego)  # visible in the file, so trying them only if they exist reveals nothing
    reader = appended or _exact(stego)
    if reader is None or not reader.salts:
        return None
    derived = DerivedKey.of(key, reader.salts[0])
    content = None
    with suppress(WrongKeyError):
        content = _read_from(stego, reader.extract(derived))
    from keyss.channels.low_bits.contents import LowBitsReader

    return Attempt(derived, content, appended is not None, isinstance(reader, LowBitsReader))


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
    """The reader of bits that only the unchanged file has: codes of a coded file, else low bits."""
    from keyss.channels.codes.channel import CodesReader
    from keyss.channels.codes.decoded import Decoded

    if isinstance(stego, CodedGaussians):
        return CodesReader.of(stego.codes)
    if decoded := Decoded.of(stego):
        return CodesReader.of(decoded.codes, decoded.exact)
    from keyss.channels.low_bits.contents import LowBitsReader

    return LowBitsReader.of(stego)


def _appended(stego: Gaussians) -> SaltedReader | None:
    from keyss.channels.appended.channel import AppendedReader

    return AppendedReader.of(stego)
