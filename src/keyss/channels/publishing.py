"""Select the channel for a way of publication; open a key in whichever channel holds its secret."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, get_args

from keyss.channels.base import Channel
from keyss.channels.container import Payload, SaltedReader, warned
from keyss.channels.foreign import copies
from keyss.channels.names import ConvertedChannel, Format, Publish
from keyss.core.errors import UsageError, WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.files.formats.common import CodedGaussians

if TYPE_CHECKING:
    from keyss.channels.colours.colours_channel import ColoursReader

SUFFIXES = {"spz": ".spz", "sog": ".sog", "compressed-ply": ".compressed.ply"}  # quantised formats


def channel_for(
    publish: Publish,
    channel: ConvertedChannel = "appended",
    format: Format | None = None,
    cover: Gaussians | None = None,
) -> Channel:
    """The channel for a model that is published "unchanged", in `format`, or "converted".

    Unchanged, secrets go into the quantised values of `format`, or of the format from which `cover` was read
    or decoded; else into low bits. Imports that channel only. Raises UsageError for unknown names.
    """
    choices = {
        "publish": (publish, Publish),
        "channel": (channel, ConvertedChannel),
        "format": (format, Format),
    }
    for name, (value, known) in choices.items():
        if value is not None and value not in get_args(known):
            raise UsageError(f"`{name}`: expected {' or '.join(get_args(known))}, got {value!r}")
    if publish == "converted" and channel == "appended":
        from keyss.channels.appended.appended_channel import APPENDED

        return APPENDED
    if publish == "converted":
        from keyss.channels.colours.colours_channel import COLOURS

        return COLOURS
    from keyss.channels.lsb.decoded import Decoded
    from keyss.channels.lsb.low_bits import LOW_BITS
    from keyss.channels.lsb.quantised import quantised_channel

    if format is None and isinstance(cover, CodedGaussians):
        return quantised_channel(cover.codes.name)
    if format in SUFFIXES:
        return quantised_channel(format)
    decoded = None if cover is None else Decoded.of(cover)
    return quantised_channel(decoded.codes.name, decoded) if decoded else LOW_BITS


def suffix_of(stego: Gaussians) -> str:
    """The suffix of a file that keeps the secrets of a published model."""
    if not isinstance(stego, CodedGaussians):
        return ".ply"
    return SUFFIXES[stego.codes.name]


def open_payload(stego: Gaussians, key: str) -> Payload:
    """The payload that `key` opens in any channel. Raises WrongKeyError, and InputError for damage.

    Warns (KeyssWarning) of Gaussians that were added or changed after hiding.
    """
    for reader in _readers(stego):
        with suppress(WrongKeyError):
            if reader is not None:
                payload = replace(reader.open(key), model_size=len(stego))
                count, suspicious = copies(stego)
                if suspicious and not payload.foreign:  # else the reader has warned
                    payload = warned(replace(payload, foreign=count))
                return payload
    raise WrongKeyError()


def _readers(stego: Gaussians) -> Iterator[SaltedReader | ColoursReader | None]:
    """The readers of a model. Each channel is imported when the previous ones opened nothing."""
    from keyss.channels.lsb.decoded import Decoded
    from keyss.channels.lsb.low_bits import LowBitsReader
    from keyss.channels.lsb.quantised import QuantisedReader

    if isinstance(stego, CodedGaussians):
        yield QuantisedReader.of(stego.codes)
    elif decoded := Decoded.of(stego):
        yield QuantisedReader.of(decoded.codes, decoded)
    else:
        yield LowBitsReader.of(stego)
    from keyss.channels.appended.appended_channel import AppendedReader

    yield AppendedReader.of(stego)
    from keyss.channels.colours.colours_channel import ColoursReader

    yield ColoursReader.of(stego)
