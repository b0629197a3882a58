"""The channel for each place of publication: one table, which everything else asks."""

from __future__ import annotations

from typing import Literal, get_args

from keyss.channels.base import Channel
from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.files.formats.common import CodedGaussians

Publish = Literal["ply", "spz", "sog", "compressed-ply", "any"]
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
    if publish == "ply":
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


def suffix_of(stego: Gaussians) -> str:
    """The suffix of a file that keeps everything a published model carries."""
    if not isinstance(stego, CodedGaussians):
        return ".ply"
    return SUFFIXES[stego.codes.name]
